"""Markov chains, in primary sample space and in path space.

A chain in primary sample space walks through the vectors of random numbers that an estimator draws,
and visits each in proportion to the luminance of the estimate. It works with any estimator of this
package.
"""
