"""Volumes, vectors, particles and tracks in the formats of other programs; `formats.FORMATS` lists them."""
