"""Metropolis light transport: chains of random numbers and of paths."""
