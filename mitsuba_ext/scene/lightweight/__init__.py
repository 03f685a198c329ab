"""Bounding volume hierarchies without pointers, for scenes that do not fit into memory with the
hierarchies of Embree or OptiX.

Source: D. Cline, PhD dissertation, Brigham Young University, 2007, chapter 3; also D. Cline, K.
Steele, P. Egbert, *Lightweight Bounding Volumes for Ray Tracing*, Journal of Graphics Tools 11(4),
2007.
"""
