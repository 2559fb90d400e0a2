"""Figures of results and comparisons: arrays in, matplotlib figures out, all in one style.

Of those that `plot` draws the first paragraph says what they show: it is their caption.
"""
