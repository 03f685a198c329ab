"""Finds which light path techniques a scene needs, from the moments of their contributions."""
