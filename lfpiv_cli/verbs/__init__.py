"""One module per verb: its options, its work on arrays and, over it, its work on files.

`import lfpiv_cli as lf` gives the functions on arrays by name; commands call those on files. Every one of these refuses
outputs that it could not write before it computes, and leaves a provenance record in what it writes. Units stand in the
names of the figures.
"""
