"""What the commands do, from Python: arrays in, arrays out, no files needed.

`import lfpiv_cli as lf` gives these functions by name. Stages call the same code and add the reading and writing.
"""
