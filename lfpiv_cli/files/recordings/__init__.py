"""Frames as cameras and programs write them; `files.images.FORMATS` lists what reads each."""
