"""Whether what was learned is worth its time: every threshold of efficiency, in one place.

Efficiency is 1 / (variance · time), relative to the decision of ``path``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from .evidence import expected_gain, expected_loss
from .prediction import Prediction

#: Renders of fewer samples, which choose by themselves what to learn, learn nothing: the fixed cost
#: of learning exceeds the time that ``path`` needs for the whole image. Compiling its kernels takes
#: ten times as long.
LEAST_SAMPLES = 1 << 18

#: The same on a GPU, which takes more samples in the time of the host's work. (On an H100, ``path``
#: takes 0.25 s for 2**25 samples of cornell_box. Learning took 1.6 s there before most of it moved
#: to the device, and has not been measured since.)
LEAST_SAMPLES_ON_GPU = 1 << 25

#: The efficiency that a learned decision must reach to be used.
LEAST = 1.03

#: The efficiency that it must reach in a trial for learning to continue; and the same for decisions
#: that more samples make better.
TRIAL, GROWING_TRIAL = 1.0, 0.95

#: The share of all pilots' samples below which a prediction is a trial.
ENOUGH = 0.2

#: The efficiency that the first map of lights must predict for a finer map to follow.
REFINING = 1.2

#: The efficiency that a map of lights must have, relative to a light tree, which needs no more
#: learning. (Whether the map of a trial or a finer one will be as good as predicted is uncertain:
#: in twelve scenes with several lights, maps have 0.5 to 2 times the efficiency of the tree.)
MAP_OVER_TREE = 1.2

#: The share of a render's time that the first map of lights may take, and a finer one.
FIRST_MAP_SHARE, FINER_MAP_SHARE = 0.05, 1 / 3

#: Renders of fewer samples, or of fewer samples for each caster, do not try connections through
#: casters. (The trial takes 0.04 s, and the table of a caster takes 0.02 s.)
LEAST_CAUSTIC_SAMPLES, SAMPLES_PER_CASTER = 1 << 21, 1 << 19

#: The efficiency that the first pilot must predict for connections through casters, and later ones.
#: (Pilots miss rare chains, and count rare bright paths that few renders have. Where they predict
#: 91 to 286, 4 to 49 is measured over all pixels; where they predict 9 to 18, 0.2 to 0.4.)
CAUSTICS, LATER_CAUSTICS = 30.0, 10.0

#: What light paths must gain, besides the time to compile their kernels.
LIGHT_PATHS = 1.1

#: A small trial ends trying if light paths are worse by more than this number of standard errors.
#: The least standard error: contrast between pixels of the trial counts as variance, which makes
#: light paths look worse the smaller a trial is.
_BEYOND_DOUBT, _LEAST_ERROR = 2.0, 0.05

#: What photons alone must gain over other light paths: no pilots test that choice, and the two
#: passes of its prediction may miss how much passes differ (variance in units of ``path``: 0.11 to
#: 0.15 in door_ajar in fog, measured 0.38; 0.02 in tissue, measured 0.06).
PHOTONS_ALONE = 4.0

#: What was learned has far less variance if it has less than this part of the variance before.
FAR_LESS = 0.4

#: The efficiency of guides that are learned from all pilots, relative to that which short ones
#: predict (door_ajar: 1.8 and 1.4).
GUIDES_GROW = 1.25

#: The same for focal points, relative to what the second pilot measures (1.2 to 1.5 in a slit).
FOCAL_POINTS_GROW = 1.4

#: Guided directions are expected to keep this power of their efficiency beside light paths. (The
#: first pilots with both have guides of few samples, and show less.)
_KEPT_BESIDE = 0.5


def least_of_casters(count: int) -> int:
    """The number of samples of a render below which connections through casters are not tried."""
    return max(LEAST_CAUSTIC_SAMPLES, count * SAMPLES_PER_CASTER)


def least_samples(is_gpu: bool) -> int:
    """The number of samples of a render below which nothing is learned."""
    return LEAST_SAMPLES_ON_GPU if is_gpu else LEAST_SAMPLES


def is_trial(share: float, is_last: bool) -> bool:
    """Whether a prediction from this share of the pilots' samples decides only if learning
    continues. ``is_last``: no pilot follows."""
    return share < ENOUGH and not is_last


def least(prediction: Prediction, is_last: bool) -> float:
    """The efficiency that a decision must reach."""
    if not is_trial(prediction.share, is_last):
        return LEAST
    return GROWING_TRIAL if prediction.grows else TRIAL


def pays(prediction: Prediction, is_last: bool) -> bool:
    """Whether the expected efficiency of a decision is high enough. A trial need not be certain."""
    error = 0.0 if is_trial(prediction.share, is_last) else prediction.error
    return is_worth(prediction.efficiency, error, least(prediction, is_last))


def prefers_tree(tree: Prediction, of_map: Prediction) -> bool:
    """Whether lights are chosen by a light tree rather than by a map."""
    return tree.efficiency >= max(LEAST, of_map.efficiency / MAP_OVER_TREE)


def is_worth(efficiency: float, error: float, least: float) -> bool:
    """Whether the expected efficiency is at least ``least``. ``error`` is the standard error of the
    logarithm of ``efficiency``."""
    return expected_gain(efficiency, error) >= np.log(least)


def beside_light_paths(efficiency: float) -> float:
    """The efficiency that guided directions are expected to keep beside light paths."""
    return efficiency**_KEPT_BESIDE


def best(
    efficiencies: np.ndarray, errors: Sequence[float], rival: float, guided: Sequence[float]
) -> tuple[int, int]:
    """The candidate of the least expected time to an error, and the best one except the first.

    Parameters:
        efficiencies: Efficiency of each candidate; the first is ``path``. The prior is that all
            are as efficient as ``rival``.
        errors: Standard errors of the logarithms of their ratios to the first one.
        rival: The efficiency of what was learned for ``path``, relative to ``path``.
        guided: For each candidate, the efficiency that guided directions add to it.
    """
    relative = efficiencies / (efficiencies[0] * rival)
    gains = [expected_gain(*x) - expected_loss(x[1]) for x in zip(relative, errors)]
    other = 1 + int(np.argmax(gains[1:]))
    return (other if gains[other] + math.log(guided[other]) > 0 else 0), other


def is_beaten(
    efficiencies: np.ndarray, errors: Sequence[float], rival: float, guided: Sequence[float]
) -> bool:
    """Whether the first candidate is the best one beyond doubt. For parameters, see :func:`best`.
    """
    other = best(efficiencies, errors, rival, guided)[1]
    doubt = math.exp(_BEYOND_DOUBT * max(errors[other], _LEAST_ERROR))
    return efficiencies[other] * guided[other] * doubt <= efficiencies[0] * rival
