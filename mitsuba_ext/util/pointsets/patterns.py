"""Patterns of points in the unit cube."""

from __future__ import annotations

import math
import numbers
import warnings

import numpy as np
import numpy.typing as npt

from .line import FloatArray

#: The patterns of :func:`points`.
PATTERNS = (
    "independent", "stratified", "latin_hypercube", "halton", "hammersley", "sobol", "lattice",
    "poisson_disk",
)  # fmt: skip

#: The number of candidates for each point of a Poisson disk pattern after the first.
_CANDIDATES = 32

#: The maximum number of products that the search for a lattice evaluates.
_LATTICE_WORK = 1 << 22


def points(
    pattern: str, count: int, dimension: int = 2, seed: int | np.random.Generator = 0
) -> FloatArray:
    """Points in [0, 1)ᴰ. In each pattern, a point chosen at random is uniformly distributed, so
    unweighted means are unbiased. ``hammersley`` and ``lattice`` are fixed sets, randomised by a
    shift around the torus and by the order of the axes (``lattice``: also by their signs).

    - ``independent``: i.i.d. uniform numbers.
    - ``stratified``: one point in each cell of a grid (jittered). Along each axis except the last,
      the grid has ⌊N^(1/D)⌋ cells. Along the last axis, the columns are divided such that each cell
      has one point: if N is not a D-th power, some columns, chosen at random, have one cell more.
    - ``latin_hypercube``: one point in each of N slices along each axis.
    - ``halton``: scrambled.
    - ``hammersley``: (i / N, Halton), shifted.
    - ``sobol``: scrambled (random linear matrices and a digital shift); its first two dimensions
      are a (0, 2)-sequence. It is best for powers of two.
    - ``lattice``: a lattice of rank one with the best of many generators, shifted.
    - ``poisson_disk``: each point is the candidate farthest from all others on the torus (Mitchell;
      Cline, PhD dissertation, section 4.5.3). Slow: its time grows with the square of the count.

    Parameters:
        pattern: One of :data:`PATTERNS`.
        count: Number of points N, at least 1.
        dimension: D.
        seed: An integer, or a generator, which is advanced.

    Returns:
        Array of shape (N, D).

    Raises:
        ValueError: The pattern is unknown, or the count or the dimension is not a positive integer.
    """
    if pattern not in PATTERNS:
        raise ValueError(f'points: pattern is "{pattern}", not one of {PATTERNS}')
    for name, value in (("count", count), ("dimension", dimension)):
        if not isinstance(value, numbers.Integral) or value < 1:
            raise ValueError(f"points: {name} is {value}, not an integer of at least 1")
    rng = np.random.default_rng(seed)
    x = MAKERS[pattern](count, dimension, rng)
    # Points stay below 1 even when rounded to single precision
    return np.minimum(x, 1 - 2.0**-24)


def shifted(points: npt.ArrayLike, shift: npt.ArrayLike) -> FloatArray:
    """The points plus ``shift``, modulo 1."""
    x = (np.asarray(points, float) + shift) % 1
    # The remainder of a tiny negative number is rounded to 1
    return np.where(x == 1, 0.0, x)


def tent(points: npt.ArrayLike) -> FloatArray:
    """1 − |2u − 1|: uniform points remain uniform, and f(tent(u)) has equal values at opposite ends
    of the cube."""
    return 1 - np.abs(2 * np.asarray(points, float) - 1)


# ---- Patterns ----


def _stratified(count: int, dimension: int, rng: np.random.Generator) -> FloatArray:
    edge = _root(count, dimension)
    columns = edge ** (dimension - 1)
    # Along the last axis, a column has as many cells as points; ``size`` is their number
    size = count // columns + (rng.permutation(columns) < count % columns)
    column = np.repeat(np.arange(columns), size)
    rank = np.arange(count) - (np.cumsum(size) - size)[column]
    x = rng.random((count, dimension))
    for axis in range(dimension - 1):
        x[:, axis] = (column // edge**axis % edge + x[:, axis]) / edge
    x[:, -1] = (rank + x[:, -1]) / size[column]
    return x


def _root(count: int, dimension: int) -> int:
    """The largest integer whose ``dimension``-th power is at most ``count``."""
    edge = round(count ** (1 / dimension))
    return edge if edge**dimension <= count else edge - 1


def _latin_hypercube(count: int, dimension: int, rng: np.random.Generator) -> FloatArray:
    return _qmc().LatinHypercube(dimension, seed=rng).random(count)


def _halton(count: int, dimension: int, rng: np.random.Generator) -> FloatArray:
    return _qmc().Halton(dimension, seed=rng).random(count)


def _hammersley(count: int, dimension: int, rng: np.random.Generator) -> FloatArray:
    x = np.arange(count)[:, None] / count
    if dimension > 1:
        x = np.hstack([x, _qmc().Halton(dimension - 1, scramble=False).random(count)])
    return shifted(x[:, rng.permutation(dimension)], rng.random(dimension))


def _sobol(count: int, dimension: int, rng: np.random.Generator) -> FloatArray:
    with warnings.catch_warnings():
        # SciPy warns about counts that are not powers of two
        warnings.simplefilter("ignore", UserWarning)
        return _qmc().Sobol(dimension, scramble=True, seed=rng).random(count)


def _lattice(count: int, dimension: int, rng: np.random.Generator) -> FloatArray:
    index = np.arange(count, dtype=np.int64)[:, None]
    # Random order and signs of the axes: an integrand may suit a lattice but not its mirror image
    generator = rng.permutation(_generator(count, dimension)) * rng.choice([-1, 1], dimension)
    return shifted(index * generator % count / count, rng.random(dimension))


def _generator(count: int, dimension: int) -> npt.NDArray[np.int64]:
    """The generator z of a Korobov lattice (powers of a number) with the smallest worst-case error
    for periodic functions of a Sobolev space: the smallest mean of Π(1 + 2π² B₂({i zₐ / N}))."""
    if count < 3 or dimension == 1:
        return np.ones(dimension, np.int64)
    most = max(1, _LATTICE_WORK // (count * dimension))
    candidates = np.array([a for a in range(1, count // 2 + 1) if math.gcd(a, count) == 1])
    if len(candidates) > most:
        # If there are too many to try, those near the golden section are good
        golden = count * (math.sqrt(5) - 1) / 2
        near = np.abs(np.minimum(golden, count - golden) - candidates)
        candidates = candidates[np.argsort(near, kind="stable")[:most]]
    i = np.arange(count, dtype=np.int64)
    # The factor of every residue i / N
    kernel = 1 + 2 * math.pi**2 * ((i / count) ** 2 - i / count + 1 / 6)
    best = None
    for a in candidates.tolist():
        z = [pow(a, power, count) for power in range(dimension)]
        product = np.ones(count)
        for generator in z:
            product *= kernel[i * generator % count]
        error = product.mean()
        if best is None or error < best[0]:
            best = error, z
    return np.array(best[1], np.int64)


def _poisson_disk(count: int, dimension: int, rng: np.random.Generator) -> FloatArray:
    x = rng.random((count, dimension))
    for i in range(1, count):
        candidates = rng.random((_CANDIDATES, 1, dimension))
        distance = np.abs(candidates - x[:i])
        distance = np.minimum(distance, 1 - distance)
        nearest = np.square(distance).sum(axis=2).min(axis=1)
        x[i] = candidates[nearest.argmax(), 0]
    return x


def _qmc():
    # Imported here because it takes longer to load than the rest of this package
    from scipy.stats import qmc

    return qmc


#: By name of a pattern, the function that makes its points from a count, a dimension and an
#: ``rng``.
MAKERS = {
    "independent": lambda count, dimension, rng: rng.random((count, dimension)),
    "stratified": _stratified,
    "latin_hypercube": _latin_hypercube,
    "halton": _halton,
    "hammersley": _hammersley,
    "sobol": _sobol,
    "lattice": _lattice,
    "poisson_disk": _poisson_disk,
}
