"""Estimators beside the plain walk: light paths, caches, chains, and defocus."""
