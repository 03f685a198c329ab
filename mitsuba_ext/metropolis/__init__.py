"""Metropolis light transport: Markov chains in primary sample space and in path space."""
