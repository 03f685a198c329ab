"""The plan of a render, made before its first pass: the stages, and how they are cut into
passes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import mitsuba as mi

from ..util.parameters import MOST_SPP
from .batches import NO_SAMPLES
from .camera import film_extent
from .device import Device
from .request import Request
from .staged import Staged
from .stages import Learning

#: Least number of samples per pixel in a pass on a CPU, also for large films: neighbouring lanes of
#: the same pixel trace coherent rays. At 1920x1080, passes of one sample take 1.6 times as long. It
#: does not apply where memory is short, nor to structured samplers, which keep a state for each
#: sample of a pass.
_PASS_SPP = 16

#: Least number of passes if an integrator that learns uses a structured sampler: pilots consist of
#: whole passes.
_MIN_STRUCTURED_PASSES = 16

#: With a timeout, passes of a structured sampler are shorter by this factor. They cannot differ in
#: length, so that the timeout can be missed by one of them.
_TIMEOUT_PASS_DIVISOR = 4

_MAX_WAVEFRONT = 1 << 32

#: Largest number of passes of a render; they take weeks.
_MOST_PASSES = 1 << 20


@dataclass(frozen=True)
class RenderPlan:
    """The samples of a render.

    Attributes:
        spp: Samples per pixel.
        stages: Samples per pixel of each stage: pilots, and the last one.
        learning: What the pilots are for.
        pixel_count: Sampled pixels of the film.
        structured: Whether the samples are stratified over the whole render. All passes then have
            the same length.
        limit: Largest number of samples per pixel in a pass.
        set_size: Number of samples of a pixel that a timeout does not separate.
        parts: Number of parts of the film, which each pass renders one after the other.
        most_lanes: Largest number of samples taken at a time for which memory suffices.
        warp: The lanes that the device runs together: they have samples of one pixel where a pass
            has that many.
    """

    spp: int
    stages: tuple[int, ...]
    learning: Learning
    pixel_count: int
    structured: bool
    limit: int
    set_size: int
    parts: int = 1
    most_lanes: int = _MAX_WAVEFRONT - 1
    warp: int = 1

    def pass_length(self, samples: int, most_lanes: int = 0) -> int:
        """Samples per pixel of a pass, if ``samples`` samples are cut into passes of about equal
        length. For ``most_lanes``, see :class:`~mitsuba_ext.rendering.stages.Stage`."""
        if self.structured:
            return self.limit
        limit = self.limit
        if most_lanes:
            limit = max(1, min(limit, most_lanes // self.pixel_count))
        limit = whole_warps(limit, self.warp)
        pass_count = -(-samples // limit)
        length = max(1, -(-samples // max(1, pass_count)))
        return min(limit, whole_warps(length + min(length, self.warp) - 1, self.warp))

    @property
    def pixels(self) -> list[range]:
        """The pixels of each part, row by row in the film's extent."""
        length = -(-self.pixel_count // self.parts)
        starts = range(0, self.pixel_count, length)
        return [range(start, min(start + length, self.pixel_count)) for start in starts]

    @property
    def longest_pass(self) -> int:
        """Samples per pixel of the longest pass."""
        return max(self.pass_length(samples) for samples in self.stages)

    def whole(self, before: int, samples: int, most: int) -> int:
        """The samples of a stage, rounded up so that the render ends with a whole set, which it
        also does with ``most`` samples. ``before`` samples were taken in earlier stages."""
        return min(most, samples + -(before + samples) % self.set_size)


def plan_render(
    integrator: Staged, request: Request, sampler: mi.Sampler, device: Device
) -> RenderPlan:
    """The plan of a render by ``device``. Sets the sampler's number of samples.

    Raises:
        ValueError: ``spp`` is out of range, the film has more pixels than a wavefront can hold, or
            ``spp`` is too large for this number of pixels.
    """
    spp, film = request.spp, request.sensor.film()
    if not 0 <= spp <= MOST_SPP:
        raise ValueError(
            f'"{integrator.name}": spp is {spp}; it must be 1 to {MOST_SPP}, or 0 for as many '
            f"as the sampler says"
        )
    if spp:
        sampler.set_sample_count(spp)
    spp = sampler.sample_count()
    if spp == 0:
        raise ValueError(f'"{integrator.name}": {NO_SAMPLES}')
    check_extent(film)
    pixel_count = math.prod(film_extent(film))
    structured = not is_independent(request.sensor)
    sample, channels = integrator.sample_bytes, integrator.channel_bytes
    sample = replace(sample, usual=sample.usual + channels)
    cost, most_lanes = integrator.sample_cost, device.lanes(sample)
    limit = device.pass_samples // (pixel_count * cost)
    if not structured and not device.is_gpu:
        limit = max(limit, min(_PASS_SPP // cost, device.most_pass_samples // pixel_count))
    if structured and request.is_timed:
        limit //= _TIMEOUT_PASS_DIVISOR
    limit = min(limit, integrator.samples_per_pass, most_lanes // pixel_count)
    limit = whole_warps(max(1, limit), device.warp)
    if spp > limit * _MOST_PASSES:
        raise ValueError(
            f'"{integrator.name}": {spp} samples for each of {pixel_count} pixels '
            f"are too many: give at most {limit * _MOST_PASSES}"
        )
    learning = integrator.plan_learning(request, spp)
    pilots = list(learning.pilots)
    # With a timeout, sets of samples are kept whole
    set_size = integrator.samples_per_set(spp) if request.is_timed else 1
    if structured:
        # Independent samples can be cut anywhere, and each pass gets a seed of its own. Samples
        # that are stratified over the whole render must come in passes of equal length, to which
        # the pilots are rounded
        if pilots:
            limit = min(limit, max(min(pilots), spp // _MIN_STRUCTURED_PASSES))
        limit = max(d for d in range(1, limit + 1) if _divides(d, spp, set_size))
        pilots = [limit * max(1, samples // limit) for samples in pilots]
    stages = (*pilots, spp - sum(pilots))
    # More than one part if even one sample of each pixel is too much at a time
    parts = -(-pixel_count // most_lanes)
    return RenderPlan(
        spp, stages, learning, pixel_count, structured, limit, set_size, parts, most_lanes,
        device.warp,
    )  # fmt: skip


def whole_warps(samples: int, warp: int) -> int:
    """The number of samples per pixel, rounded down so that warps are not split between pixels: to
    a multiple of ``warp``, or a power of two below it. 0 if there are no samples."""
    if samples >= warp:
        return samples - samples % warp
    return 1 << (samples.bit_length() - 1) if samples > 0 else 0


def _divides(length: int, spp: int, set_size: int) -> bool:
    """Whether the samples can be cut into passes of this length."""
    return spp % length == 0 and (set_size % length == 0 or length % set_size == 0)


def is_independent(sensor: mi.Sensor) -> bool:
    """Whether the sensor's sampler draws each sample independently of the pixel's others."""
    return sensor.sampler().class_name() == "IndependentSampler"


def check_extent(film: mi.Film) -> None:
    """Refuses a film that one pass cannot fill.

    Raises:
        ValueError: The film has more pixels than a wavefront can hold.
    """
    width, height = film_extent(film)
    if width * height >= _MAX_WAVEFRONT:
        raise ValueError(
            f"a film of {width}x{height} pixels exceeds the 2^32 samples of one pass"
        )
