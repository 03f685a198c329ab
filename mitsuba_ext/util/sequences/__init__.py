"""Point sequences for samplers: their coordinates, and the randomization that makes them
independent between pixels and between sets of dimensions."""
