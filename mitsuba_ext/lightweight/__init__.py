"""Bounding volume hierarchies without pointers [1], for scenes that do not fit into memory with the
hierarchies of Embree or OptiX.

[1] Cline, Steele, Egbert. Lightweight Bounding Volumes for Ray Tracing. Journal of Graphics Tools
11(4), 2007; Cline. PhD dissertation, Brigham Young University, 2007, chapter 3.
"""
