"""Velocity fields that are fitted to scattered or gridded velocities, and what follows from them."""
