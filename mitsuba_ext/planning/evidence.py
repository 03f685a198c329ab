"""What pilots tell about the efficiency of a learned decision.

The benefit of a decision is the ratio of the efficiencies, 1 / (variance · time), with it and
without. Variance and time are estimated from pilots:

- Variance: the variance of the image from the paths of a pilot, and the variance that these paths
  would have with the decision of ``path``. The paths are divided into batches, from which the
  uncertainty of the ratio is estimated. The brightest paths, one in 32768 and one in each pass at
  least, are left out: they would dominate the estimate.
- Time: segments of paths and shadow rays are counted, and the additional cost of a decision is a
  constant. A clock would be more accurate on an idle machine, but renders with equal seeds could
  choose differently, above all on a busy machine.

The prior is that efficiency does not change. It weighs more, the less certain an estimate is.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ..util.arrays import joined

#: The number of batches of paths; one path in ``TRIM`` is left out.
BATCHES, TRIM = 32, 1 << 15

#: On the device, paths are divided into this number of groups.
_GROUPS = 1 << 10

#: The prior: the standard deviation, over scenes, of the logarithm of a decision's efficiency.
_PRIOR = 0.5


def trimmed_batches(error: np.ndarray, more: np.ndarray) -> np.ndarray:
    """Sums over batches of paths, without the brightest ones.

    Parameters:
        error: The squared error of each path.
        more: By how much it would be larger without the decision.

    Returns:
        Both sums, shape [2, BATCHES].
    """
    more = np.where(np.isfinite(more), more, 0)
    count = -(-len(error) // TRIM)
    keep = np.ones(len(error), bool)
    if count:
        keep[np.argpartition(error + np.abs(more), -count)[-count:]] = False
    batch = np.arange(len(error)) % BATCHES
    return np.stack(
        [np.bincount(batch, np.where(keep, x, 0), BATCHES) for x in (error, more)]
    ).astype(np.float64)


def brightest_kept(square: mi.Float) -> mi.Float:
    """The brightness of the brightest path that is not left out, from the brightness of all paths;
    infinity if there are too few of them to leave one out."""
    left_out = -(-len(square) // TRIM)
    if len(square) <= left_out:
        return dr.opaque(mi.Float, dr.inf)
    # The groups of paths show where to look: few values are copied to the host
    length = -(-len(square) // _GROUPS)
    groups = dr.block_reduce(dr.ReduceOp.Max, square, length, mode="evaluated")
    bright = dr.compress(square >= _largest(groups, left_out + 1))
    return _largest(dr.gather(mi.Float, square, bright), left_out + 1)


def _largest(values: mi.Float, number: int) -> mi.Float:
    """The largest value but ``number`` − 1; the smallest if there are fewer."""
    place = max(len(values) - number, 0)
    return dr.opaque(mi.Float, float(np.partition(values.numpy(), place)[place]))


class PathSums:
    """The sums of :func:`trimmed_batches` on the device, over all passes of a stage, and sums of
    other quantities. All of them are copied to the host at once.

    The paths of a pass are divided into groups, and at most one path of a group is left out, its
    brightest one.

    Parameters:
        others: The number of other quantities.
    """

    def __init__(self, others: int) -> None:
        self._sums = dr.zeros(mi.Float64, (4 + others) * BATCHES)

    def add(self, error: mi.Float, more: mi.Float, *others: mi.Float) -> None:
        """Adds the paths of a pass.

        Parameters:
            error, more: See :func:`trimmed_batches`. Here, ``more`` must be finite.
            others: Other quantities of each path.
        """
        columns, size = [error, more, *others], len(error)
        dr.eval(columns)
        brightest, held, sums = _group_sums(columns, dr.opaque(mi.UInt32, size))
        dr.eval(brightest, held, sums)
        # The groups of a batch follow one another
        lane, length = dr.arange(mi.UInt32, _GROUPS), _GROUPS // BATCHES
        group = lane % length * BATCHES + lane // length
        is_kept = _rank(brightest, group) >= dr.opaque(mi.UInt32, -(-size // TRIM))
        held, sums = (
            [dr.gather(mi.Float64, x, group) for x in columns] for columns in (held, sums)
        )
        kept = [x + dr.select(is_kept, y, 0) for x, y in zip(sums, held)]
        left_out = [dr.select(is_kept, 0, x) for x in held]
        found = joined([*kept, *left_out, *sums[2:]])
        self._sums += dr.block_sum(found, length)
        dr.eval(self._sums)

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """The sums without the brightest paths, shape [2, BATCHES]; and the sums of all quantities
        over all paths, shape [2 + others]."""
        sums = self._sums.numpy().reshape(-1, BATCHES)
        total = sums.sum(axis=1)
        return sums[:2], np.concatenate([total[:2] + total[2:4], total[4:]])


@dr.syntax
def _group_sums(columns: Sequence[mi.Float], size: mi.UInt32):
    """Divides paths into groups: path i belongs to group i mod ``_GROUPS``.

    Returns:
        The brightness of the brightest path of each group; the first two quantities of this path;
        and the sums of all quantities, without these two. Sums have a fixed order.
    """
    path = dr.arange(mi.UInt32, _GROUPS)
    group = mi.Float(-1), [mi.Float64(0)] * 2, [mi.Float64(0)] * len(columns)
    while path < size:
        group = _with(group, [mi.Float64(dr.gather(mi.Float, x, path)) for x in columns])
        path += _GROUPS
    return group


def _with(group: tuple, values: list[mi.Float64]) -> tuple:
    """What :func:`_group_sums` returns, with one path more. The path that was the brightest until
    now joins the sums."""
    brightest, held, sums = group
    brightness = mi.Float(values[0] + dr.abs(values[1]))
    is_brightest, pairs = brightness > brightest, list(zip(held, values))
    held = [dr.select(is_brightest, new, old) for old, new in pairs]
    others = [dr.select(is_brightest, old, new) for old, new in pairs]
    sums = [x + y for x, y in zip(sums, [*others, *values[2:]])]
    return dr.maximum(brightest, brightness), held, sums


@dr.syntax
def _rank(brightest: mi.Float, group: mi.UInt32):
    """The number of groups whose brightest path precedes the one of ``group``."""
    own, rank = dr.gather(mi.Float, brightest, group), mi.UInt32(0)
    other = mi.UInt32(0)
    while other < _GROUPS:
        its = dr.gather(mi.Float, brightest, other)
        rank += dr.select((its > own) | ((its == own) & (other < group)), mi.UInt32(1), 0)
        other += 1
    return rank


def gain_of(sums: np.ndarray) -> tuple[float, float]:
    """The relative reduction of variance by a decision, and the standard error of the logarithm of
    the remaining variance.

    Parameters:
        sums: Those of :func:`trimmed_batches`, or such sums of another quantity; shape
            [2, batches].
    """
    error, more = sums.sum(axis=1)
    if error <= 0 or error + more <= 0:
        return 0.0, 0.0
    left = error / (error + more)
    # Jackknife: leave out one batch at a time
    others, more_of_others = error - sums[0], more - sums[1]
    ratios = others / np.maximum(others + more_of_others, 1e-300)
    count = sums.shape[1]
    deviation = np.log(np.maximum(ratios, 1e-6) / left)
    return 1 - left, float(np.sqrt((count - 1) / count * np.square(deviation).sum()))


def expected_gain(efficiency: float, error: float) -> float:
    """The logarithm of the expected efficiency, for an estimate ``efficiency`` whose logarithm has
    the standard error ``error``.

    The less certain the estimate, the closer to one is the expected efficiency. A significance test
    instead would make the choice depend on the seed where pilots are noisy and the possible gain is
    large."""
    if efficiency <= 0:
        return -np.inf
    return _PRIOR**2 / (_PRIOR**2 + error**2) * float(np.log(efficiency))


def expected_loss(error: float) -> float:
    """By how much the logarithm of the expected time to an error exceeds −:func:`expected_gain`:
    half the variance of what is not known of the logarithm."""
    return 0.5 * _PRIOR**2 * error**2 / (_PRIOR**2 + error**2)
