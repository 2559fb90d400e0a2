"""One module per command: read, call the core, write, return the summary.

Every stage refuses outputs that it could not write before it computes, and leaves a provenance record in what it
writes. Units stand in the names of the figures.
"""
