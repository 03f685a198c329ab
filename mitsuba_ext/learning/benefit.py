"""Whether what was learned is worth its time.

The benefit of a decision is the ratio of the efficiencies, 1 / (variance · time), with it and
without. Pilots tell both, each with its uncertainty:

- The variance is that of the image by the paths of a pilot, and what it would be if the decision
  had been that of ``path``. The paths are divided into batches, which tell how well the ratio is
  known. The brightest paths, one in 32768 and one in each pass at least, are left out: they would
  decide alone.
- The time is calibrated: rays are counted, and what a decision adds to them is known in units of
  the time of a ray. A clock would be closer to the truth on an idle machine, but equal seeds would
  choose differently, and on a busy machine everybody would.

The prior is that nothing is gained or lost: what is uncertain counts less the less is known.
"""

from __future__ import annotations

import numpy as np

#: What decisions cost for each event, in units of the time of a ray: choosing a light from a table
#: (medians over 15 scenes: 0.1 to 0.4), guiding the first direction of a path (0.3 to 1), and each
#: further one. ``benchmarks/decision_costs.py`` measures them.
TABLE, FIRST_GUIDED, GUIDED = 0.2, 0.7, 0.25

#: Batches of paths, and one path in so many is left out.
BATCHES, TRIM = 32, 1 << 15

#: What decisions gain in scenes at large: the standard deviation of the logarithm.
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
    """By how much, relatively, a decision lowers the variance, and the standard error of the
    logarithm of what is left.

    Parameters:
        sums: Of :func:`trimmed_batches`, or the same of any quantity; shape [2, batches].
    """
    error, more = sums.sum(axis=1)
    if error <= 0 or error + more <= 0:
        return 0.0, 0.0
    left = error / (error + more)
    # Leaving out one batch at a time
    others, more_of_others = error - sums[0], more - sums[1]
    ratios = others / np.maximum(others + more_of_others, 1e-300)
    count = sums.shape[1]
    deviation = np.log(np.maximum(ratios, 1e-6) / left)
    return 1 - left, float(np.sqrt((count - 1) / count * np.square(deviation).sum()))


def is_worth(efficiency: float, error: float, least: float) -> bool:
    """Is ``least`` to be expected of an efficiency of which the logarithm is known up to ``error``?

    The less is known of the efficiency, the closer to one it is expected to be. To ask for
    certainty instead would leave the choice to the seed where pilots are noisy and much is to
    gain."""
    known = _PRIOR**2 / (_PRIOR**2 + error**2)
    return efficiency > 0 and known * np.log(efficiency) >= np.log(least)
