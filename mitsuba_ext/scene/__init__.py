"""Facts about a loaded scene: bounds, media, portals, what moves, which integrators are nested."""
