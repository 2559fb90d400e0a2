"""lfpiv: from raw light-field camera images to three-dimensional velocity fields."""

__version__ = "0.1.0"
