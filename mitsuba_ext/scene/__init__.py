"""Queries about a loaded scene: bounds, media, portals, lights, motion, and nested integrators."""
