"""The samplers that a scene can name: samplers of sensors, and decisions of the random walk, which
are nested in an integrator."""
