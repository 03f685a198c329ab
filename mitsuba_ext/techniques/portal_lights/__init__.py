"""Directions of an environment through portals."""
