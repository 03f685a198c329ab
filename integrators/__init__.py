"""The integrators that a scene can name: one file each, parameters and wiring only."""
