"""Utilities that do not depend on scenes: arrays, files, errors, parameters, point sets, and
sequences."""
