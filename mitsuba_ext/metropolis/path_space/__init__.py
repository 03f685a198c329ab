"""Light paths as points of surfaces, the densities of the ways to make them, and mutations."""
