"""Light paths as lists of vertices, the densities of the techniques that make them, and
mutations."""
