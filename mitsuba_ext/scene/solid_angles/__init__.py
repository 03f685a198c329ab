"""Solid angles of shapes seen from a point, and maps from the unit square to directions in them. No
module here depends on a scene."""
