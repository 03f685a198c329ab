"""Which vertices of light paths a vertex is connected to, by learned visibility of regions."""
