"""Lights that are chosen by a light tree."""
