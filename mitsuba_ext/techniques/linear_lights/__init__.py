"""Lights that are chosen by an estimate of what each contributes to the vertex."""
