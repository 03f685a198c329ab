"""Directions of an environment by the product of BSDF, light and learned visibility."""
