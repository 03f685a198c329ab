"""What replaces the decisions of the random walk: a folder for each slot. The contracts are in
``transport/path_decisions.py``. Decisions do not learn: ``learning`` makes them of ``maps``."""
