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

import numpy as np

#: The number of batches of paths; one path in ``TRIM`` is left out.
BATCHES, TRIM = 32, 1 << 15

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
