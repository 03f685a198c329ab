"""Irradiance that is computed at a few places, and interpolated between them."""
