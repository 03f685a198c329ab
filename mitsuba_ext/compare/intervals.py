"""Estimates with their 95 % confidence intervals over independent runs.

Errors and times are positive and vary by factors. The confidence interval of the mean logarithm
(Student's t) is therefore applied as a factor around the estimate. With three runs, t is 4.3, and
the interval is wide.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from scipy.special import stdtrit

CONFIDENCE = 0.95


class Estimate(NamedTuple):
    """A value and its confidence interval; unknown bounds, as of a single run, are ``None``."""

    value: float
    low: float | None = None
    high: float | None = None


def mean(values: Sequence[float]) -> Estimate | None:
    """The mean of one value per run; ``None`` without values, or if one is not finite."""
    return _around(statistics.fmean, values)


def median(values: Sequence[float]) -> Estimate | None:
    """The median, for times: other programs on the machine can only lengthen them."""
    return _around(statistics.median, values)


def ratio(
    numerator: Estimate | None, denominator: Estimate | None, pairs: Iterable[tuple[float, float]]
) -> Estimate | None:
    """The ratio of two estimates.

    Args:
        numerator, denominator: The estimates whose values are divided.
        pairs: One (numerator, denominator) for each round in which both ran. The interval comes
            from their ratios, in which shared influences of a round (machine load, seed) cancel.
    """
    if numerator is None or denominator is None or not denominator.value > 0:
        return None
    value = numerator.value / denominator.value
    return _with_factor(value, [a / b for a, b in pairs if a > 0 and b > 0])


def slope(x: Sequence[float], y: Sequence[float]) -> Estimate | None:
    """The slope of log y against log x over all runs, each independent of the others."""
    fit = _log_fit(x, y)
    if fit is None:
        return None
    if len(fit.x) < 3:
        return Estimate(fit.slope)
    half = _student(len(fit.x) - 2) * fit.deviation / math.sqrt(fit.spread)
    return Estimate(fit.slope, fit.slope - half, fit.slope + half)


def cost_of(target: float, x: Sequence[float], y: Sequence[float]) -> Estimate | None:
    """The ``x`` at which the line fitted to log y against log x reaches ``target`` (inverse
    prediction, by the delta method). ``None`` if the slope is not negative; without an interval if
    the confidence interval of the slope includes positive values."""
    fit = _log_fit(x, y)
    if fit is None or not fit.slope < 0:
        return None
    at = fit.mean_x + (math.log(target) - fit.mean_y) / fit.slope
    count = len(fit.x)
    if count < 3:
        return Estimate(math.exp(at))
    uncertainty = _student(count - 2) * fit.deviation
    if fit.slope + uncertainty / math.sqrt(fit.spread) >= 0:
        return Estimate(math.exp(at))
    leverage = 1 / count + (at - fit.mean_x) ** 2 / fit.spread
    half = uncertainty / -fit.slope * math.sqrt(leverage)
    return Estimate(math.exp(at), math.exp(at - half), math.exp(at + half))


def follow(at: Estimate | None, x: Sequence[float], y: Sequence[float]) -> Estimate | None:
    """The y at an estimated x, on the line fitted to log y against log x. The line maps the
    interval of x to the interval of y; the uncertainty of the line itself is ignored."""
    fit = _log_fit(x, y)
    if at is None or fit is None:
        return None

    def value(x: float | None) -> float | None:
        if x is None:
            return None
        return math.exp(fit.mean_y + fit.slope * (math.log(x) - fit.mean_x))

    return Estimate(*map(value, at))


class _Fit(NamedTuple):
    x: list[float]
    mean_x: float
    mean_y: float
    slope: float
    spread: float  # Σ (x − mean_x)²
    deviation: float  # of the residuals


def _log_fit(x: Sequence[float], y: Sequence[float]) -> _Fit | None:
    points = [(math.log(a), math.log(b)) for a, b in zip(x, y) if a > 0 and b > 0]
    if len({a for a, _ in points}) < 2:
        return None
    log_x, log_y = [a for a, _ in points], [b for _, b in points]
    mean_x, mean_y = statistics.fmean(log_x), statistics.fmean(log_y)
    spread = sum((a - mean_x) ** 2 for a in log_x)
    slope = sum((a - mean_x) * (b - mean_y) for a, b in points) / spread
    residual = sum((b - mean_y - slope * (a - mean_x)) ** 2 for a, b in points)
    deviation = math.sqrt(residual / (len(points) - 2)) if len(points) > 2 else 0.0
    return _Fit(log_x, mean_x, mean_y, slope, spread, deviation)


def _around(center, values: Sequence[float]) -> Estimate | None:
    if not values or not all(math.isfinite(value) for value in values):
        return None
    value = float(center(values))
    if min(values) <= 0:
        # Zero and negative values (a fraction, a count, an error after a subtraction) have no
        # logarithm: use the interval of the values themselves
        half = _half_width(values)
        return Estimate(value) if half is None else Estimate(value, value - half, value + half)
    return _with_factor(value, values)


def _with_factor(value: float, samples: Sequence[float]) -> Estimate:
    half = _half_width([math.log(sample) for sample in samples])
    if half is None or half > 700:  # exp() would overflow
        return Estimate(value)
    return Estimate(value, value * math.exp(-half), value * math.exp(half))


def _half_width(samples: Sequence[float]) -> float | None:
    if len(samples) < 2:
        return None
    return _student(len(samples) - 1) * statistics.stdev(samples) / math.sqrt(len(samples))


def _student(degrees: int) -> float:
    return float(stdtrit(degrees, (1 + CONFIDENCE) / 2))
