"""Utilities without scenes: arrays, files, errors, parameters, point sets, and sequences."""
