"""FLIP: the perceived difference when flipping between two images, from 0 (equal) to 1.

HDR-FLIP [1] is the largest LDR-FLIP [2] over a range of exposures. NVIDIA's ``flip-evaluator``
computes it, but crashes when an exposure is infinite (an image that is black or very dim), and does
not support references that are mostly black. The exposures are therefore computed here, by the same
rule, after both images are divided by the brightest pixel of the reference: FLIP does not depend on
the scale of the radiance, and the exposures depend only on the reference.

[1] Andersson, Nilsson, Shirley, Akenine-Möller. Visualizing Errors in Rendered High Dynamic Range
Images. Eurographics Short Papers 2021.
[2] Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström, Fairchild. FLIP: A Difference Evaluator
for Alternating Images. HPG 2020.
"""

from __future__ import annotations

import math
import os
from types import ModuleType

import numpy as np

#: The luminance that the tone curve (ACES) maps to 0.85. The exposures range from the one that maps
#: the brightest pixel to it to the one that maps the median to it [1].
_EXPOSED = 2**1.0832972

#: The luminance, relative to the brightest pixel, below which the median counts as black: this
#: limits the number of exposures to 23.
_BLACK = 2**-23

#: The multiple of the brightest pixel at which images are clipped. It is white at every exposure:
#: larger values would not change FLIP, but could overflow.
_WHITE = 100

_WAIT_POLICY = "OMP_WAIT_POLICY"

_LUMINANCE = (0.2126, 0.7152, 0.0722)


def mean_flip(image: np.ndarray, reference: np.ndarray) -> float:
    """The mean of HDR-FLIP over all pixels.

    The viewing condition is FLIP's default: 67 pixels per degree (a 0.7 m wide 4K monitor
    seen from 0.7 m). Negative values, which filters with negative lobes produce, count as 0. All
    cores are used; the result does not depend on their number. The cost is proportional to the
    number of pixels and of exposures (log₂ of the range of luminance above the median, at least 2).

    Args:
        image: Finite linear RGB, (height, width, 3).
        reference: The reference, same shape. It sets the exposures, so the order matters.

    Returns:
        A number from 0 to 1; NaN if ``flip-evaluator`` is not installed (it has no wheels for
        Linux on ARM), or if no pixel of the reference is brighter than 0.
    """
    evaluator = _evaluator()
    reference = np.maximum(reference, 0, dtype=np.float64)
    luminance = reference @ np.array(_LUMINANCE)
    brightest = luminance.max()
    if evaluator is None or not brightest > 0:
        return math.nan
    pixels = [
        np.ascontiguousarray(np.clip(array / brightest, 0, _WHITE), dtype=np.float32)
        for array in (reference, np.asarray(image, np.float64))
    ]
    middle = luminance.size // 2
    median = np.partition(luminance, middle, axis=None)[middle] / brightest
    start = math.log2(_EXPOSED)
    stop = start - math.log2(max(median, _BLACK))
    exposures = {
        "startExposure": start,
        "stopExposure": stop,
        "numExposures": max(2, math.ceil(stop - start)),
    }
    # Not flip-evaluator's mean, a sum in single precision (an error of 0.02 % at 1920x1080)
    error_map, _, _ = evaluator.evaluate(
        *pixels, "HDR", applyMagma=False, computeMeanError=False, parameters=exposures
    )
    return float(error_map.mean(dtype=np.float64))


def _evaluator() -> ModuleType | None:
    """The package, with OpenMP threads that sleep when they wait.

    By default they spin. They then slow down whatever is measured in the 8 ms after a call, and on
    a busy machine, they slow each other down (2 times at 320x180, 50 times for tiny images).
    """
    policy = os.environ.get(_WAIT_POLICY)
    os.environ.setdefault(_WAIT_POLICY, "PASSIVE")  # read once, at the import
    try:
        import flip_evaluator
    except ImportError:
        return None
    finally:
        if policy is None:
            del os.environ[_WAIT_POLICY]
    return flip_evaluator
