"""Shapes as lights that are sampled by the solid angle that they subtend."""
