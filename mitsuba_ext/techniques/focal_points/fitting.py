"""Finds the boxes through which light passes, from the lines along which paths have found it.

A line is explained by one of the boxes that it crosses, anywhere along it and beyond surfaces too,
or by the BSDF. Expectation maximization finds the probabilities with which the lines are most
likely: each line is divided among the boxes in proportion to their densities, so that boxes in
which lines cross gain, and others lose. Boxes that gain are divided into eight, those that lose are
left out.

Source: A. Rath et al., *Focal Path Guiding for Light Transport Simulation*, SIGGRAPH 2023.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

#: Boxes along the longest edge of the region at first, and how often boxes are fitted: between two
#: fits, they are divided.
_FIRST, _FITS = 8, 4

#: The region is larger by this part of its longest edge, on all sides: virtual images lie outside.
#: It contains all vertices except this share at either end of each axis.
_MARGIN, _OUTSIDE = 0.15, 0.01

#: Steps of expectation maximization of each fit, and in each level of regions.
_STEPS, _REGION_STEPS = 10, 10

#: Boxes of a smaller probability are left out.
_LEAST = 2e-3

#: Boxes are larger than where they were found by this part of their edges, on each side: nothing is
#: known between the lines.
_PADDING = 0.25

#: The weight, in lines, of the surrounding region as the prior of a region.
_PRIOR = 32.0

#: The least probability of a BSDF sample.
_LEAST_BSDF = 0.2

_CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)


class LineArrays(NamedTuple):
    """Lines as arrays of NumPy.

    Attributes:
        p, d: Vertices and directions; shape [lines, 3].
        region: The regions of the vertices; shape [lines].
        bsdf: The densities of the directions among BSDF samples; shape [lines].
        weight: How much light was found; shape [lines].
    """

    p: np.ndarray
    d: np.ndarray
    region: np.ndarray
    bsdf: np.ndarray
    weight: np.ndarray


def fitted_boxes(lines: LineArrays, most: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The corners of at most ``most`` boxes, and their probabilities; the rest is for the BSDF."""
    low, high = _first_boxes(lines.p)
    probability = np.full(len(low) + 1, 0.5 / len(low))
    probability[0] = 0.5
    for fit in range(_FITS):
        densities = _densities(low, high, lines)
        probability = _maximized(densities, lines.weight, probability)
        order = 1 + np.argsort(-probability[1:], kind="stable")[:most]
        order = order[probability[order] > _LEAST]
        low, high = low[order - 1], high[order - 1]
        probability = np.concatenate([probability[:1], probability[order]])
        is_heavy = probability[1:] > 1 / most
        if fit == _FITS - 1 or not is_heavy.any():
            break
        half = 0.5 * (high - low)[is_heavy, None]
        children = low[is_heavy, None] + _CORNERS * half
        light = np.concatenate([[True], ~is_heavy])
        parts = np.repeat(probability[1:][is_heavy] / 8, 8)
        probability = np.concatenate([probability[light], parts])
        high = np.concatenate([high[~is_heavy], (children + half).reshape(-1, 3)])
        low = np.concatenate([low[~is_heavy], children.reshape(-1, 3)])
    padding = _PADDING * (high - low)
    return low - padding, high + padding, probability[1:]


def fitted_rows(
    lines: LineArrays,
    low: np.ndarray,
    high: np.ndarray,
    probability: np.ndarray,
    levels: Sequence[slice],
    parent: np.ndarray,
) -> np.ndarray:
    """The probabilities of boxes in each region; shape [regions, boxes].

    Parameters:
        probability: Their probabilities in the whole scene.
        levels, parent: See :class:`~mitsuba_ext.scene.regions.nested_regions.NestedRegions`.
    """
    densities = _densities(low, high, lines)
    rows = np.zeros((levels[-1].stop, len(low) + 1), np.float32)
    rows[:] = np.concatenate([[1 - probability.sum()], probability])
    ancestor = lines.region.astype(np.int64)
    chain = []
    for level in reversed(levels):
        is_here = ancestor >= level.start
        chain.append((level, is_here, ancestor))
        ancestor = np.where(is_here, parent[ancestor], ancestor) if level.start else ancestor
    for level, is_here, region in reversed(chain):
        if level.start:
            rows[level] = rows[parent[level]]
        here = np.flatnonzero(is_here)
        if len(here) == 0:
            continue
        prior = np.float32(_PRIOR) * (rows[parent[level]] if level.start else rows[level])
        place = region[here] - level.start
        order = np.argsort(place, kind="stable")
        here, place = here[order], place[order]
        first = np.flatnonzero(np.diff(place, prepend=-1))
        own = level.start + place[first]
        prior, densities_here = prior[place[first]], densities[here]
        which = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(place))))
        for _ in range(_REGION_STEPS):
            shares = densities_here * rows[own][which]
            shares *= (lines.weight[here] / np.maximum(shares.sum(axis=1), 1e-30))[:, None]
            counts = np.add.reduceat(shares, first) + prior
            rows[own] = counts / counts.sum(axis=1, keepdims=True)
    boxes = rows[:, 1:]
    excess = np.maximum(boxes.sum(axis=1, keepdims=True), 1e-30) / (1 - _LEAST_BSDF)
    return boxes / np.maximum(excess, 1)


def _first_boxes(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The corners of cubes around all vertices, except for outliers."""
    low, high = np.quantile(p, [_OUTSIDE, 1 - _OUTSIDE], axis=0)
    size = max((high - low).max(), 1e-4 * np.abs(p).max(), 1e-6)
    low, high = low - _MARGIN * size, high + _MARGIN * size
    edge = (high - low).max() / _FIRST
    counts = np.maximum(np.ceil((high - low) / edge - 1e-6), 1).astype(int)
    cells = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), -1).reshape(-1, 3)
    first = low + cells * edge
    return first, first + edge


def _densities(low: np.ndarray, high: np.ndarray, lines: LineArrays) -> np.ndarray:
    """The density of each line among BSDF samples, and among directions to each box; shape
    [lines, 1 + boxes]."""
    # In single precision, in place: these are the largest arrays
    low, high, p = (np.float32(x) for x in (low, high, lines.p))
    inverse = 1 / np.where(np.abs(lines.d) > 1e-12, lines.d, np.float32(1e-12))
    enters = np.zeros((len(p), len(low)), np.float32)
    leaves = np.full_like(enters, np.inf)
    for axis in range(3):
        a, b = (x[:, axis] - p[:, axis, None] for x in (low, high))
        a *= inverse[:, axis, None]
        b *= inverse[:, axis, None]
        np.maximum(enters, np.minimum(a, b), out=enters)
        np.minimum(leaves, np.maximum(a, b, out=b), out=leaves)
    cubes = leaves - enters
    crosses = cubes > 0
    leaves *= leaves + enters
    leaves += enters * enters
    cubes *= leaves
    cubes *= crosses
    cubes *= np.float32(1 / (3 * np.prod(high - low, axis=1, dtype=np.float64)))
    return np.column_stack([lines.bsdf, cubes])


def _maximized(densities: np.ndarray, weight: np.ndarray, probability: np.ndarray) -> np.ndarray:
    """The probabilities after some steps of expectation maximization."""
    probability = np.float32(probability)
    for _ in range(_STEPS):
        # Not a product of matrices: NumPy's threads would take ten times as long as the sums
        share = weight / np.maximum(np.einsum("lb,b->l", densities, probability), 1e-30)
        probability = probability * np.einsum("l,lb->b", share, densities)
        probability = probability / probability.sum()
    return probability
