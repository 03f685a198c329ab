"""Chooses the light path vertices to which a vertex is connected, by learned visibility of
regions."""
