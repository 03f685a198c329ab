"""Paths from lights: emission, the light walk with its stored vertices, and the sensor's end."""
