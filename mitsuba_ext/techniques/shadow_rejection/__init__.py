"""Russian roulette on shadow rays by learned visibility."""
