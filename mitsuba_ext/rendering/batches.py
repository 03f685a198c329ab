"""Mean and variance of an image from independent batches: the same render at several seeds.

This works for any integrator, because it uses whole images only: also for those that do not go
through ``sample()`` (light tracing, Metropolis) or whose samples depend on each other (learning).
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene.unseen import check_all_is_seen
from ..startup.garbage import garbage_left_alone
from ..util.stored_arrays import StoredArrays
from .camera import film_told, find_sensor

#: What is wrong with a sampler that has no samples.
NO_SAMPLES = "the sampler has 0 samples per pixel (sample_count): give it 1 or more"


class Batches:
    """Running mean and variance of batches, each weighted by its samples. Memory and cost per batch
    do not grow with the number of batches.

    Attributes:
        channels: Names of the channels: the film's image, then the integrator's AOVs.
        image_channel_count: Number of channels of the image, alpha included.
        spp: Samples per pixel of all batches together.
    """

    def __init__(self, channels: Sequence[str], image_channel_count: int) -> None:
        self.channels = tuple(channels)
        self.image_channel_count = image_channel_count
        # Count, samples, mean, sum of squared deviations, each times the batch's samples
        self._state = (0, 0, np.float64(0), np.float64(0))

    def add(self, image: np.ndarray, spp: int) -> None:
        """Adds the image of a batch."""
        # Welford's update in double precision, which avoids the difference of large sums
        count, samples, mean, squares = self._state
        with np.errstate(invalid="ignore", over="ignore"):  # pixels may be infinite
            deviation = image.astype(np.float64) - mean
            mean = mean + deviation * (spp / (samples + spp))
            squares = squares + spp * deviation * (image - mean)
        # In one assignment, because Ctrl-C may interrupt at any time
        self._state = (count + 1, samples + spp, mean, squares)

    def plus(self, other: Batches) -> Batches:
        """The batches of both objects together, which must be independent."""
        (count, samples, mean, squares), (more, added, its_mean, its_squares) = (
            self._state, other._state
        )  # fmt: skip
        total, share = Batches(self.channels, self.image_channel_count), 0.0
        if added:
            share = added / (samples + added)
        with np.errstate(invalid="ignore", over="ignore"):
            deviation = its_mean - mean
            total._state = (
                count + more,
                samples + added,
                mean + deviation * share,
                squares + its_squares + deviation**2 * (samples * share),
            )
        return total

    def arrays(self) -> dict[str, np.ndarray]:
        """The state as arrays, for :meth:`from_arrays`."""
        count, samples, mean, squares = self._state
        return {
            "channels": np.array(self.channels), "mean": np.asarray(mean),
            "image_channel_count": np.array(self.image_channel_count),
            "count": np.array(count), "samples": np.array(samples),
            "weighted_squares": np.asarray(squares),
        }  # fmt: skip

    @classmethod
    def from_arrays(cls, arrays: StoredArrays, most_bytes: int = 1 << 40) -> Batches:
        """The inverse of :meth:`arrays`.

        Args:
            most_bytes: The most bytes of one of the arrays.

        Raises:
            DamagedError: They are no batches.
        """
        channels = arrays.texts("channels")
        arrays.require(bool(channels), "no channels")
        batches = cls(channels, arrays.number("image_channel_count", "iu", 1, len(channels)))
        count, samples = (arrays.number(key, "iu", 0, 1 << 62) for key in ("count", "samples"))
        mean, squares = np.float64(0), np.float64(0)
        if count:
            # Pixels may be infinite, or NaN
            shape, limits = (None, None, len(channels)), (-np.inf, np.inf)
            mean = arrays.take("mean", "f", shape, *limits, most_bytes)
            squares = arrays.take("weighted_squares", "f", mean.shape, *limits, most_bytes)
        batches._state = count, samples, mean, squares
        return batches

    def save(self, path: Path) -> None:
        """Writes the batches to a file that :meth:`load` reads."""
        with open(path, "wb") as file:
            np.savez(file, **self.arrays())

    @classmethod
    def load(cls, path: Path) -> Batches:
        """Reads a file that :meth:`save` has written.

        Raises:
            OSError, ValueError, KeyError, zipfile.BadZipFile: The file is missing or damaged.
        """
        with np.load(path) as stored:
            return cls.from_arrays(StoredArrays.of(dict(stored)))

    @property
    def spp(self) -> int:
        return self._state[1]

    @property
    def count(self) -> int:
        return self._state[0]

    @property
    def mean(self) -> np.ndarray:
        """Array (height, width, channels), double precision. A pixel that is NaN or infinite in any
        batch is not finite."""
        return self._state[2]

    @property
    def variance(self) -> np.ndarray:
        """Unbiased estimate of the variance of :attr:`mean`, same shape; NaN after one batch."""
        count, samples, mean, squares = self._state
        if count < 2:
            return np.full_like(mean, np.nan)
        with np.errstate(invalid="ignore"):  # pixels may be infinite
            return squares / (count - 1) / samples


def each_batch(
    integrator: mi.Integrator,
    scene: mi.Scene,
    sensor: int | mi.Sensor,
    batch_spp: int,
    seeds: Iterable[int],
    batches: Batches | None = None,
    **wishes: Any,
) -> Iterator[Batches]:
    """Renders one batch per seed, and yields the same :class:`Batches` object after each. The
    caller may stop at any time, and keeps the finished batches after an exception.

    Args:
        integrator, scene, sensor: What to render; a sensor may be given by its index.
        batch_spp: Samples per pixel of each batch; stratified samplers round up.
        seeds: Seeds of the batches, by :func:`batch_seeds`. With others, images could be correlated
            by the way in which integrators and samplers use their seed.
        batches: Earlier batches to continue.
        wishes: Further arguments of the integrator's ``render()``.

    Raises:
        NotImplementedError: The scene has moving shapes, and the integrator does not support them.
    """
    check_all_is_seen(integrator, scene)
    sensor = find_sensor(scene, sensor)
    batch_spp = sample_count(sensor, batch_spp)
    # Removes the AOVs of an earlier render
    sensor.film().prepare([])
    for seed in seeds:
        image = _render(integrator, scene, sensor, batch_spp, seed, wishes)
        if batches is None:
            batches = _no_batches(sensor.film())
        batches.add(_complete(image, sensor.film(), len(batches.channels)), batch_spp)
        yield batches


def batch_seeds(seed: int | mi.UInt32, count: int, first: int = 0) -> list[int]:
    """Seeds of ``count`` batches of a render with the given seed, from batch ``first`` on.

    They are hashes of 32 bits. With consecutive seeds, renders with neighbouring seeds would share
    batches, and Mitsuba's stratified samplers give pixel p at seed s + spp the numbers of pixel
    p + 1 at seed s. They are the second output of TEA, because our integrators use the first output
    for the seeds of their passes: otherwise, pass k of one batch would repeat batch k.
    """
    if isinstance(seed, mi.UInt32):
        seed = seed[0]
    seed = operator.index(seed) & 0xFFFFFFFF
    index = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
    return mi.sample_tea_32(dr.opaque(mi.UInt32, seed), index)[1].numpy().tolist()


def sample_count(sensor: mi.Sensor, spp: int) -> int:
    """The samples per pixel that a render with ``spp`` takes, since stratified samplers round up. 0
    stands for the sampler's own number.

    Raises:
        ValueError: The sampler has no samples.
    """
    sampler = sensor.sampler()
    before = sampler.sample_count()
    if spp:
        sampler.set_sample_count(spp)
    count = sampler.sample_count()
    sampler.set_sample_count(before)
    if count == 0:
        raise ValueError(NO_SAMPLES)
    return count


def _render(
    integrator: mi.Integrator, scene: mi.Scene, sensor: mi.Sensor, spp: int, seed: int,
    wishes: Mapping[str, Any],
) -> np.ndarray:  # fmt: skip
    sampler = sensor.sampler()
    before = sampler.sample_count()
    try:
        with dr.suspend_grad(), garbage_left_alone(), film_told(sensor):
            # "prb" refuses develop=False
            return integrator.render(
                scene, sensor=sensor, seed=seed, spp=spp, develop=True, evaluate=True, **wishes
            ).numpy()
    finally:
        sampler.set_sample_count(before)  # Mitsuba's integrators change it


def _no_batches(film: mi.Film) -> Batches:
    """An empty object for images with the channels of a film that has just been rendered to."""
    return Batches([field.name for field in film.bitmap().struct_()], film.base_channels_count())


def _complete(image: np.ndarray, film: mi.Film, channel_count: int) -> np.ndarray:
    """The image with the channels of the film.

    The image that "aov" returns lacks channels that it leaves in the film. Colour and alpha are
    therefore taken from ``image``, and the other channels, which have names, from the film.
    """
    if image.shape[2] == channel_count:
        return image
    base = film.base_channels_count()
    return np.concatenate([image[..., :base], film.develop().numpy()[..., base:]], axis=2)
