"""Estimates densities over cells for all tiles of a film, from few samples of each.

What a tile has counted is drawn towards what larger tiles around it have counted, as far as these
differ by no more than chance: an empirical Bayes estimate. It goes from one tile that is the whole
film to the smallest, and in each of them from the root of the tree of cells to its leaves. At a
node, with ``h`` the share of the left half among ``n`` samples, and ``p`` what the tile around
expects, the estimate is the mean of a beta distribution::

    (n h + κ p) / (n + κ)

How far tiles really differ from the ones around them, ρ = 1 / (κ + 1), is estimated from all nodes
of a tile and its neighbours (the variance of ``h`` is p (1 − p) (1 / n + ρ (1 − 1 / n))). Where
nothing exceeds chance, ρ is 0, and the tile has the map of the one around it: in the end that of
the whole film, or uniform numbers.

Source: the propagation in two rows of D. Cline, PhD dissertation, BYU 2007, section 9.2.3, is
replaced; the estimate is the beta-binomial one by moments (J. C. Kleinman, *Proportions with
Extraneous Variance*, 1973).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Form(NamedTuple):
    """How the density of a cell follows from what its samples bring.

    Attributes:
        is_root: Is it in proportion to the root of the mean of a cell, and not to the mean? The
            variance is least with the mean where all samples of a cell bring the same, and with the
            root where some of them bring nothing.
        floor: The share of uniform numbers.
    """

    is_root: bool
    floor: float


#: Probabilities closer to 0 or 1 are not believed when tiles are compared.
_LEAST_PROBABILITY = 0.02


def estimate(counts: np.ndarray, squares: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """The share of each cell in what each tile brings.

    Parameters:
        counts: Sums of what samples brought, [row, column, map of the tile, cell].
        squares: Sums of their squares, [row, column, map of the tile]: they tell how many samples
            of equal size the sums are worth.
        widths: The share of each cell where nothing is known.

    Returns:
        Shares, in the shape of ``counts``; those of a map add up to one.
    """
    levels = [(counts.astype(np.float32), squares.astype(np.float64))]
    while max(levels[-1][0].shape[:2]) > 1:
        levels.append(tuple(map(_halved, levels[-1])))
    shares = np.broadcast_to(widths.astype(np.float32), levels[-1][0].shape)
    while levels:
        sums, squares = levels.pop()
        shares = _updated(_enlarged(shares, *sums.shape[:2]), sums, squares)
    return shares


def density(shares: np.ndarray, widths: np.ndarray, form: Form) -> np.ndarray:
    """The probability of each cell.

    Parameters:
        shares: Of cells in what the samples bring.
        widths: Of the cells.
        form: How the one follows from the other.
    """
    widths = widths.astype(np.float32)
    mass = shares
    if form.is_root:
        mass = np.sqrt(shares * widths)
        mass /= np.maximum(mass.sum(-1, keepdims=True), 1e-20)
    return (1 - np.float32(form.floor)) * mass + np.float32(form.floor) * widths


def expected_ratio(mass: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """The second moment, relative to that of uniform numbers, of what is in proportion to a density
    and drawn from it."""
    inverse = np.where(widths > 0, 1 / np.where(widths > 0, widths, 1), 0)
    return 1 / np.einsum("...i,...i,i->...", mass, mass, inverse.astype(np.float32))


def _updated(shares: np.ndarray, sums: np.ndarray, squares: np.ndarray) -> np.ndarray:
    """What a tile knows, where the tile around it expects ``shares``."""
    total = sums.sum(-1, dtype=np.float64)
    samples = np.divide(np.square(total), squares, where=squares > 0, out=np.zeros_like(total))
    scale = np.divide(samples, total, where=total > 0, out=np.zeros_like(total))
    scale = scale[..., None].astype(np.float32)
    nodes, excess, weight, chance = [], 0.0, 0.0, 0.0
    own, expected = sums, shares
    while own.shape[-1] > 1:
        left, expected_left = own[..., 0::2], expected[..., 0::2]
        own, expected = left + own[..., 1::2], expected_left + expected[..., 1::2]
        h, p = _share(left, own), _share(expected_left, expected)
        n = own * scale
        nodes.append((h, p, n))
        is_known = (n > 1) & (p > 0) & (p < 1)
        q = np.clip(p, _LEAST_PROBABILITY, 1 - _LEAST_PROBABILITY)
        excess = excess + ((n * np.square(h - p) / (q * (1 - q)) - 1) * is_known).sum(-1)
        weight = weight + ((n - 1) * is_known).sum(-1)
        chance = chance + 2.0 * is_known.sum(-1)
    excess, weight, chance = map(_pooled, (excess, weight, chance))
    # One standard deviation of what chance brings is not believed
    difference = np.maximum(excess - np.sqrt(chance), 0) / np.maximum(weight, 1e-6)
    rho = np.clip(difference, 0, 1)[..., None].astype(np.float32)
    result = np.ones((*shares.shape[:-1], 1), np.float32)
    for h, p, n in reversed(nodes):
        # n / (n + κ), without dividing by ρ = 0
        believed = n * rho / np.maximum(n * rho + (1 - rho), 1e-6)
        whole, left = result, p + believed * (h - p)
        result = np.empty((*shares.shape[:-1], 2 * whole.shape[-1]), np.float32)
        result[..., 0::2] = whole * left
        result[..., 1::2] = whole - result[..., 0::2]
    return result


def _share(left: np.ndarray, both: np.ndarray) -> np.ndarray:
    """The share of the left half; 1/2 where there is nothing."""
    nothing = both <= 0
    return (left + np.float32(0.5) * nothing) / (both + nothing)


def _pooled(x: np.ndarray) -> np.ndarray:
    """Sums over each tile and its neighbours."""
    for axis in range(2):
        padding = [(1, 1) if a == axis else (0, 0) for a in range(x.ndim)]
        wide, size = np.pad(x, padding), x.shape[axis]
        x = sum(wide.take(range(i, i + size), axis) for i in range(3))
    return x


def _halved(x: np.ndarray) -> np.ndarray:
    """Sums over 2 x 2 tiles."""
    padding = [(0, x.shape[0] % 2), (0, x.shape[1] % 2)] + [(0, 0)] * (x.ndim - 2)
    x = np.pad(x, padding)
    x = x[0::2] + x[1::2]
    return x[:, 0::2] + x[:, 1::2]


def _enlarged(x: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """What tiles half as large would have: a bilinear interpolation."""
    if x.shape[:2] == (rows, columns):
        return x
    for axis, size in enumerate((rows, columns)):
        index = np.arange(size)
        nearest = index // 2
        next_one = np.clip(nearest + np.where(index % 2, 1, -1), 0, x.shape[axis] - 1)
        x = 0.75 * x.take(nearest, axis) + 0.25 * x.take(next_one, axis)
    return x.astype(np.float32)
