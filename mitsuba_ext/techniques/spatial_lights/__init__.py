"""Lights that are chosen by their power, also from each voxel."""
