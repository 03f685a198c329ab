"""Lights that are resampled from a few candidates."""
