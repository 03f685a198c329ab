"""Directions to the places through which light passes."""
