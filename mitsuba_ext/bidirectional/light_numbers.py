"""The random numbers of light paths."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..transport.numbers import BothEnds, Numbers


def light_numbers(sampler: Numbers, lanes: int) -> Numbers:
    """The random numbers of light paths: ``sampler``, unless it is Mitsuba 3.9.1's ``ldsampler``.
    Its pairs of numbers depend on each other: some points of a lamp would be combined with some
    directions more often than with others (up to 6 % too bright in a quarter of an image). Light
    paths then use independent numbers, whose seed comes from the sampler. Markov chains have
    separate numbers for light paths (``BothEnds``).

    Parameters:
        lanes: Number of light paths.
    """
    if isinstance(sampler, BothEnds):
        return sampler.light
    if not isinstance(sampler, mi.Sampler) or sampler.class_name() != "LowDiscrepancySampler":
        return sampler
    numbers = mi.load_dict({"type": "independent"})
    # A random number has 24 bits
    seed = mi.UInt32(sampler.next_1d() * float(1 << 24))
    numbers.seed(dr.gather(mi.UInt32, seed, 0), lanes)
    return numbers
