"""Lights that are chosen by what pilots have found."""
