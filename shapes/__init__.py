"""The shapes that a scene can name: one file each."""
