"""The tables and figures of the paper that this program is built on, computed and put beside the paper's own.

A module for each group of them, listed in `registry`; each is a function that gets its `Work` and returns `Findings`.
"""
