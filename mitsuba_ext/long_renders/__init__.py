"""Renders of many independent batches: they can be saved, gone on with, merged and divided."""
