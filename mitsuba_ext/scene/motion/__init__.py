"""Rigid motion in time, and the parameters that describe it."""
