"""Markov chains of primary samples: the third core.

A chain walks through the vectors of random numbers that an estimator draws, and visits each in
proportion to the luminance of what the estimator makes of it. The estimator is any of ours.
"""
