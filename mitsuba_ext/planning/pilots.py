"""How many samples pilots take, and how much these weigh in the image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mitsuba as mi
import numpy as np

from .technique import Technique

#: Where each pilot has as many samples as all before it, pilots may have half of all samples from
#: this number of samples per pixel on, as they then cost little; below, a quarter.
_MANY_SAMPLES = 8

#: Elsewhere, pilots have at most an eighth of all samples, and a sixteenth beyond this number of
#: paths: where a path takes little time, recording it and building trees takes as long again. In
#: short renders they may have a quarter, up to ``_FEW_SAMPLES`` of each pixel, from which three
#: pilots can be made. (docs/results/auto_path.md)
_ENOUGH_PATHS, _FEW_SAMPLES = 1 << 18, 4

#: Approximate number of paths of each of the first two pilots, which measure the benefit of
#: learning.
_TRIAL_PATHS = 1 << 17

#: The largest relative rise of variance, by unequal weights of samples, where learning is no help.
_MOST_LOSS = 0.015

#: Where maps help, a sample that is drawn from a map of n samples per pixel is worth about
#: (n + _UNIFORM) / (n + _HALF) of one that is drawn from a perfect map.
_UNIFORM, _HALF = 0.1, 1.5

#: The first sample of all pixels is divided into stages until the first of them takes no more than
#: this share of all samples, as these are drawn from uniform numbers. It has at least this number
#: of pixels: Dr.Jit's tracing of a stage takes as long as the paths of as many.
_FIRST_SHARE, _LEAST_PIXELS = 1 / 32, 1 << 13


def pilot_samples(
    slots: Mapping[str, Technique],
    scene: mi.Scene,
    pixel_count: int,
    spp: int,
    pilot_spp: int,
    most: int,
) -> list[int]:
    """The samples per pixel of each pilot.

    Pilots have at most half of all samples where each pilot doubles the samples
    (``Technique.doubles``). The first two pilots are short trials: if learning does not pay off,
    little time has been spent. The later pilots already use what was learned from all before them.

    Parameters:
        slots: The techniques that fill the slots of the walk.
        scene: The scene.
        pixel_count: Sampled pixels of the film.
        spp: Samples per pixel of the render.
        pilot_spp: Samples per pixel of all pilots, as the scene asks for them.
        most: The most of them, where they do not double (:func:`most_samples`).
    """
    samples = min(pilot_spp, most)
    learning = [t for t in slots.values() if t.pilot_spp and t.can_learn(scene, samples)]
    if not learning:
        return []
    if all(technique.pilot_paths for technique in learning):
        enough = max(technique.pilot_paths for technique in learning)
        # At least two samples of a pixel, to estimate their variance
        samples = min(samples, max(2, -(-enough // pixel_count)))
    if all(technique.doubles for technique in learning):
        return doubling_pilots(min(pilot_spp, spp // 2 if spp >= _MANY_SAMPLES else spp // 4))
    if samples < 3 or all(not technique.tries for technique in learning):
        return [samples]
    quarter = samples // 4 or 1
    trial = max(1, _TRIAL_PATHS // pixel_count)
    if 2 * trial > quarter:
        return [quarter, quarter, samples - 2 * quarter]
    rest = samples - 2 * trial
    return [trial, trial, quarter, rest - quarter]


def most_samples(pixel_count: int, spp: int) -> int:
    """The most samples per pixel of all pilots, where they do not double, in a render with ``spp``
    samples of each pixel."""
    enough = max(spp // 16, -(-_ENOUGH_PATHS // pixel_count))
    return max(min(spp // 8, enough), min(spp // 4, _FEW_SAMPLES))


def doubling_pilots(samples: int) -> list[int]:
    """The samples per pixel of each pilot: one, and then as many as in all pilots before it."""
    pilots = [1]
    while 2 * sum(pilots) <= samples:
        pilots.append(sum(pilots))
    pilots[-1] += samples - sum(pilots)
    return pilots


def first_parts(pixel_count: int, spp: int) -> int:
    """Into how many stages the first of ``spp`` samples of all pixels is divided."""
    parts = 1
    while 0.5 ** (parts - 1) > _FIRST_SHARE * spp and pixel_count >> parts >= _LEAST_PIXELS:
        parts += 1
    return parts


def stage_weights(stages: Sequence[int], parts: int = 1) -> list[float]:
    """For each stage, the weight of its samples relative to the last stage, where each pilot
    doubles the samples (``Technique.doubles``).

    Weights must not depend on any sample: if bright pilots were more likely to be left out, the
    image would be too dark. Where learning helps much, equal weights would leave most of the noise
    to samples of the first stages. Where it does not help, unequal weights raise the variance by
    1.5 % at most, which limits them.

    Parameters:
        stages: Samples per pixel of each stage.
        parts: Into how many stages the first one is divided.
    """
    count = len(stages) + parts - 1
    # The share of the pixels in each part of the first stage
    shares = [0.5 ** (parts - max(part, 1)) for part in range(parts)] if parts > 1 else [1.0]
    known = np.cumsum([0.0, *(stages[0] * share for share in shares), *stages[1:]])[:count]
    wanted = (known + _UNIFORM) / (known + _HALF)
    return _weights(stages, shares, wanted / wanted[-1])


def weights_by_share(stages: Sequence[int]) -> list[float]:
    """The same where pilots do not double. A sample is thought to be worth as much as the share of
    all pilots that its stage has learned from."""
    known = np.cumsum([0.0, *stages[:-1]])
    return _weights(stages, [1.0], known / known[-1]) if known[-1] else [1.0] * len(stages)


def _weights(
    stages: Sequence[int], shares: Sequence[float], wanted: np.ndarray
) -> list[float]:
    """The weights nearest to ``wanted`` that raise the variance by no more than ``_MOST_LOSS``.

    Parameters:
        shares: The share of the pixels in each part of the first stage.
    """
    wanted, parts = wanted.tolist(), len(shares)

    def weights(share: float) -> list[float]:
        return [1 - share * (1 - weight) for weight in wanted]

    def loss_of_pixel(first: float, others: Sequence[float]) -> float:
        pairs = [(stages[0], first), *zip(stages[1:], others)]
        mean = sum(n * w for n, w in pairs)
        return sum(stages) * sum(n * w * w for n, w in pairs) / mean**2 - 1

    def loss(share: float) -> float:
        every = weights(share)
        return sum(s * loss_of_pixel(every[k], every[parts:]) for k, s in enumerate(shares))

    low, high = 0.0, 1.0
    if loss(high) <= _MOST_LOSS:
        return weights(high)
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if loss(middle) <= _MOST_LOSS else (low, middle)
    return weights(low)
