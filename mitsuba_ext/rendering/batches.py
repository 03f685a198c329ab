"""Mean and variance of an image from independent batches: the same render at several seeds.

This works for any integrator, also for those that do not go through ``sample()`` (light tracing,
Metropolis) or whose samples depend on each other (learning), since it looks at whole images only.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..garbage import garbage_left_alone
from ..movers import check_motion_is_seen
from .camera import find_sensor


class Batches:
    """Mean and variance of the batches so far. Neither memory nor cost per batch grow with their
    number.

    Attributes:
        channels: Names of the channels: those of the film's image, then the integrator's AOVs.
        image_channel_count: How many of them are the image, alpha included.
        spp: Samples per pixel of all batches together.
    """

    def __init__(self, channels: Sequence[str], image_channel_count: int) -> None:
        self.channels = tuple(channels)
        self.image_channel_count = image_channel_count
        self.spp = 0
        # Count, mean, sum of squared deviations
        self._state = (0, np.float64(0), np.float64(0))

    def add(self, image: np.ndarray, spp: int) -> None:
        """Takes the image of a batch in."""
        # Welford's update, in double precision: a difference of large sums is never taken
        count, mean, squares = self._state
        with np.errstate(invalid="ignore", over="ignore"):  # pixels may be infinite
            deviation = image.astype(np.float64) - mean
            mean = mean + deviation / (count + 1)
            squares = squares + deviation * (image - mean)
        # At once: Ctrl-C may come at any time
        self._state = (count + 1, mean, squares)
        self.spp += spp

    def save(self, path: Path) -> None:
        """Writes everything to a file, from which :meth:`load` makes an equal object."""
        count, mean, squares = self._state
        with open(path, "wb") as file:
            np.savez(
                file, channels=self.channels, image_channel_count=self.image_channel_count,
                spp=self.spp, count=count, mean=mean, squares=squares,
            )

    @classmethod
    def load(cls, path: Path) -> Batches:
        """Reads what :meth:`save` wrote.

        Raises:
            OSError, ValueError, KeyError, zipfile.BadZipFile: The file is missing or damaged.
        """
        with np.load(path) as stored:
            batches = cls(stored["channels"].tolist(), int(stored["image_channel_count"]))
            batches.spp = int(stored["spp"])
            batches._state = (int(stored["count"]), stored["mean"], stored["squares"])
        return batches

    @property
    def count(self) -> int:
        return self._state[0]

    @property
    def mean(self) -> np.ndarray:
        """Array (height, width, channels), double precision. NaN or infinity in any batch is still
        there."""
        return self._state[1]

    @property
    def variance(self) -> np.ndarray:
        """Unbiased estimate of the variance of :attr:`mean`, same shape; NaN after one batch."""
        count, mean, squares = self._state
        if count < 2:
            return np.full_like(mean, np.nan)
        return squares / (count - 1) / count


def each_batch(
    integrator: mi.Integrator,
    scene: mi.Scene,
    sensor: int | mi.Sensor,
    batch_spp: int,
    seeds: Iterable[int],
    batches: Batches | None = None,
) -> Iterator[Batches]:
    """Renders one batch per seed, in steps: yields, after each batch, one and the same object. The
    caller may stop at any time, and keeps the finished batches after an exception.

    Args:
        integrator, scene, sensor: What to render; a sensor may be given by its index.
        batch_spp: Samples per pixel of each batch; stratified samplers round up.
        seeds: Of the batches. All different, and such that the integrator's own use of a seed does
            not make images depend on each other: :func:`batch_seeds`.
        batches: Earlier ones, to go on from.

    Raises:
        NotImplementedError: Something moves, and the integrator does not see it.
    """
    check_motion_is_seen(integrator, scene)
    sensor = find_sensor(scene, sensor)
    batch_spp = sample_count(sensor, batch_spp)
    # Whatever AOVs an earlier render left there
    sensor.film().prepare([])
    for seed in seeds:
        image = _render(integrator, scene, sensor, batch_spp, seed)
        if batches is None:
            batches = _no_batches(sensor.film())
        batches.add(_complete(image, sensor.film(), len(batches.channels)), batch_spp)
        yield batches


def batch_seeds(seed: int | mi.UInt32, count: int) -> list[int]:
    """Seeds of ``count`` batches of a render with the given seed.

    Scattered over all 32 bits: neighbouring seeds would share batches if they were consecutive, and
    Mitsuba's stratified samplers give pixel p at seed s + spp the numbers of pixel p + 1 at seed s.
    The second output of TEA, since our integrators take the first for the seeds of their passes:
    with that, pass k of one batch would repeat batch k.
    """
    if isinstance(seed, mi.UInt32):
        seed = seed[0]
    seed = operator.index(seed) & 0xFFFFFFFF
    return mi.sample_tea_32(mi.UInt32(seed), dr.arange(mi.UInt32, count))[1].numpy().tolist()


def sample_count(sensor: mi.Sensor, spp: int) -> int:
    """The samples per pixel of a render that asks for ``spp`` (0: as many as the sampler says):
    stratified samplers round up."""
    sampler = sensor.sampler()
    before = sampler.sample_count()
    if spp:
        sampler.set_sample_count(spp)
    count = sampler.sample_count()
    sampler.set_sample_count(before)
    return count


def _render(
    integrator: mi.Integrator, scene: mi.Scene, sensor: mi.Sensor, spp: int, seed: int
) -> np.ndarray:
    sampler = sensor.sampler()
    before = sampler.sample_count()
    try:
        with dr.suspend_grad(), garbage_left_alone():
            # Developed: "prb" refuses to do without
            return integrator.render(
                scene, sensor=sensor, seed=seed, spp=spp, develop=True, evaluate=True
            ).numpy()
    finally:
        sampler.set_sample_count(before)  # Mitsuba's integrators change it


def _no_batches(film: mi.Film) -> Batches:
    """For images with the channels of a film that has just been rendered to."""
    return Batches([field.name for field in film.bitmap().struct_()], film.base_channels_count())


def _complete(image: np.ndarray, film: mi.Film, channel_count: int) -> np.ndarray:
    """An image with the channels that the film has.

    "aov" returns others than it leaves in the film. Its image is the nested integrator's; of the
    rest, only the film's channels have names.
    """
    if image.shape[2] == channel_count:
        return image
    base = film.base_channels_count()
    return np.concatenate([image[..., :base], film.develop().numpy()[..., base:]], axis=2)
