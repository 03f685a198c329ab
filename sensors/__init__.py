"""The sensors that a scene can name: one file each."""
