"""The samplers that a scene can name: decisions of the walk, which are nested in an integrator."""
