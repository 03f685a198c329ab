"""Target functions of chains whose integrals are known, and histograms of what chains visit."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from mitsuba_ext.estimators.chains.chains import MutationCounts
from mitsuba_ext.estimators.chains.target import Contribution, ImageTarget
from mitsuba_ext.transport.estimator import Sample


class Histogram:
    """Stands in for an image: the sums of visits and of uniform samples in each bin of the unit
    square, and of visits · target."""

    def __init__(self) -> None:
        self.visits, self.uniform = (dr.zeros(mi.Float, BINS**2) for _ in range(2))
        self.total = dr.zeros(mi.Float64, 1)
        self.counts: list[MutationCounts] = []

    def _bin(self, found: Contribution) -> mi.UInt32:
        place = mi.Point2u(found.position * BINS)
        return place.y * BINS + place.x

    def add(self, found: Contribution, weight: mi.Float) -> None:
        dr.scatter_add(self.visits, found.value.x * weight, self._bin(found))
        dr.scatter_add(self.total, mi.Float64(found.target) * mi.Float64(weight), mi.UInt32(0))

    def add_uniform(self, found: Contribution, weight: mi.Float) -> None:
        dr.scatter_add(self.uniform, found.value.x * weight, self._bin(found))

    def tensors(self) -> list[Any]:
        return [self.visits, self.uniform, self.total]


def found_at(x: mi.Float, y: mi.Float, target: mi.Float) -> tuple[Contribution, Sample]:
    zero = dr.zeros(mi.UInt32, dr.width(x))
    sample = Sample(mi.Color3f(target), mi.Bool(True), zero, zero, zero)
    return Contribution(mi.Point2f(x, y), mi.Color3f(target), target), sample


def ramp(numbers: Any) -> tuple[Contribution, Sample]:
    """A target of one number. It is black below 1/4, where chains must not stay."""
    x = numbers.next_1d()
    return found_at(x, mi.Float(0.1), dr.maximum(x - 0.25, 0) ** 2)


def _hill(numbers: Any) -> tuple[Contribution, Sample]:
    """A target of two numbers: a hill on a plain, beside a high plateau."""
    x, y = numbers.next_2d()
    plateau = dr.select((x > 0.625) & (y > 0.75), 2, 0)
    return found_at(x, y, 0.05 + 3 * dr.exp(-60 * ((x - 0.2) ** 2 + (y - 0.3) ** 2)) + plateau)


@dr.syntax
def _varying(numbers: Any) -> tuple[Contribution, Sample]:
    """A target whose first number says how many others there are: none, two, or up to six, which
    depends on their values. If there are others, the mean over all except the first two is 2 x
    y."""
    x = numbers.next_1d()
    y, target = mi.Float(0.1), mi.Float(0.7)
    if x > 0.5:
        y = numbers.next_1d()
        target = y * numbers.next_1d() * 4 * x
    index = dr.select(x > 0.75, mi.UInt32(0), 4)
    while (index < 4) & (target < 1.5):
        target *= 0.5 + numbers.next_1d()  # 1 on average
        index += 1
    return found_at(x, y, target)


@dr.syntax
def _both_ends(numbers: Any) -> tuple[Contribution, Sample]:
    """The same, with all but the first number from the other end of the path."""
    x = numbers.next_1d()
    light = numbers.light
    y, target = mi.Float(0.1), mi.Float(0.7)
    if x > 0.5:
        y = light.next_1d()
        target = y * light.next_1d() * 4 * x
    index = dr.select(x > 0.75, mi.UInt32(0), 4)
    while (index < 4) & (target < 1.5):
        target *= 0.5 + light.next_1d()
        index += 1
    return found_at(x, y, target)


#: Bins of a histogram along each axis, and their edges.
BINS = 8
EDGES = np.arange(BINS + 1) / BINS


def _integrals_of_ramp() -> np.ndarray:
    exact = np.zeros((BINS, BINS))
    exact[0] = np.diff(np.maximum(EDGES - 0.25, 0) ** 3) / 3
    return exact


def _integrals_of_hill() -> np.ndarray:
    x, y = (np.diff(stats.norm.cdf(EDGES, centre, 120**-0.5)) for centre in (0.2, 0.3))
    exact = 0.05 / BINS**2 + 3 * math.pi / 60 * np.outer(y, x)
    exact[6:, 5:] += 2 / BINS**2
    return exact


def _integrals_of_varying() -> np.ndarray:
    exact = np.outer(np.diff(EDGES**2), np.diff(EDGES**2)) / 2
    exact[:, :4] = 0
    exact[0, :4] = 0.7 / BINS
    return exact


class Target(ImageTarget):
    """A function instead of a scene."""

    def __init__(self, function: Any, has_light_paths: bool = False) -> None:
        super().__init__(None, None, None, 1, has_light_paths)
        self._function = function

    def _camera(self, numbers: Any, active: mi.Bool) -> tuple[Contribution, Sample]:
        found, sample = self._function(numbers)
        found.target = dr.select(active, found.target, 0)
        return found, sample


#: Target functions, and their integrals over the bins: [y, x].
TARGETS = {
    "ramp": (Target(ramp), _integrals_of_ramp()),
    "hill": (Target(_hill), _integrals_of_hill()),
    "varying": (Target(_varying), _integrals_of_varying()),
    "both ends": (Target(_both_ends, True), _integrals_of_varying()),
}
