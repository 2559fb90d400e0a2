"""Figures of results and comparisons: arrays in, matplotlib figures out, all in one style."""
