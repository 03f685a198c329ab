"""Renders that consist of many independent batches and can be saved, continued, merged, and
distributed."""
