"""The samplers that a scene can name: those of sensors, and decisions of the walk, which are nested
in an integrator."""
