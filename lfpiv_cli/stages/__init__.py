"""The comparisons of `validate`, a module for each: read, call the core, write, return the summary.

Each refuses outputs that it could not write before it computes, and leaves a provenance record in what it writes.
"""
