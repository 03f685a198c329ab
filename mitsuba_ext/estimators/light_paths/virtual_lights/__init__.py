"""Instant radiosity: vertices of light paths as virtual lights."""
