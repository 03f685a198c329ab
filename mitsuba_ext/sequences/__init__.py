"""Sequences of points for samplers: their coordinates, and what makes them independent of each
other from pixel to pixel and from set to set of dimensions."""
