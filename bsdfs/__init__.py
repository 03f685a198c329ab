"""The BSDFs that a scene can name: one file each."""
