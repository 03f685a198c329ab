"""Sample swarming: maps of primary samples for each tile of the film."""
