"""The emitters that a scene can name: one file each."""
