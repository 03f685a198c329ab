"""Renders in independent batches, which can be saved, continued, merged, and distributed."""
