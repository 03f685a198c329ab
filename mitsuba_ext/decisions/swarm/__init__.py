"""Sample swarming: maps of primary samples that tiles of pixels learn and share."""
