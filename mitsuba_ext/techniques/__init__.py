"""Replacements of the decisions of the random walk. A folder holds all of one technique: its
parameters, its decision, what learns it, and what it learns."""
