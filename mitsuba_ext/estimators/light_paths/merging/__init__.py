"""Merging of the vertices of camera paths with nearby vertices of light paths."""
