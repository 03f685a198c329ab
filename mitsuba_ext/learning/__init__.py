"""Learners, which observe pilot samples (``learner.py``), their records, and the estimate whether a
learned decision is worth its time (``benefit.py``). One folder for each decision, as in
``decisions``."""
