"""Which techniques of light paths a scene needs, from the moments of their contributions."""
