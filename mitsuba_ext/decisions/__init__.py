"""What can replace the decisions of the random walk: a folder for each slot, with the decision, who
learns it, and what is learned. The contracts are in ``transport/path_decisions.py``."""
