"""Volumes, vectors, particles and tracks in the formats of other programs: a module for each, `formats` lists them."""
