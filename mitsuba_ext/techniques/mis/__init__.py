"""Heuristics of multiple importance sampling."""
