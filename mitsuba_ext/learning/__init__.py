"""Who learns: learners that observe pilot samples (``learner.py``), what they record, and whether
what they have learned pays (``benefit.py``). A folder for each slot, as in ``decisions``."""
