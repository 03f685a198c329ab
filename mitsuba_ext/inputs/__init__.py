"""Reads and checks the user's input: scene files, integrators with parameters, variants."""
