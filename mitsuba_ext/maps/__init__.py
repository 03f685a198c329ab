"""Learned data: tables of lights, visibilities and densities, with lookups that decisions trace
into kernels. Nothing here depends on the learners that fill them or the decisions that read them.
"""
