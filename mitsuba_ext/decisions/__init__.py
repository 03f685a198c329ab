"""Replacements for the decisions of the random walk, one folder for each. Their base classes are in
``transport/path_decisions.py``. Decisions do not learn: ``learning`` makes them from ``maps``."""
