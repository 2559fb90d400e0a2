"""Frames as cameras and programs write them: a module for each format, `formats` lists them."""
