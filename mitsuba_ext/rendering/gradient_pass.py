"""From the derivative of a loss with respect to an image to derivatives of the scene's parameters:
the functions that ``frozen.py`` records."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..scene.gradients import RoughBSDFs
from ..transport.decisions import CameraSamples
from ..transport.estimator import CameraRays, Sample
from ..transport.frozen import frozen, with_recordings
from ..transport.mirrored_directions import MirroredDirections, PairedNumbers
from ..transport.numbers import Numbers
from ..transport.replay import FirstPass, Replay
from ..transport.walk import Walk
from . import camera


@dataclass
class ReplayedWalk:
    """A walk along whose paths derivatives are propagated.

    Attributes:
        walk: The walk.
        flights: Whether flights through media have gradients.
        fills_gaps: Whether media that scatter nothing have gradients (``detours.py``).
        mirrors: Whether mirrors, smooth glass or masks have gradients.
        masks: Which BSDFs contain masks around mirrors, if any is optimized.
        rough: The BSDFs whose roughness is optimized: lanes form pairs, and samplers are
            :class:`PairedNumbers`. ``None`` if there are none.
    """

    walk: Walk
    flights: bool = False
    fills_gaps: bool = False
    mirrors: bool = False
    masks: mi.Bool | None = None
    rough: RoughBSDFs | None = None

    def numbers(self, sampler: mi.Sampler, seed: mi.UInt32) -> Numbers:
        """The random numbers of the walk."""
        return sampler if self.rough is None else PairedNumbers.begin(sampler, seed)

    def first(
        self, scene: mi.Scene, sampler: Numbers, rays: CameraRays, active: mi.Bool | bool = True
    ) -> tuple[Sample, tuple[mi.Spectrum, mi.Spectrum | None]]:
        """The first of two passes along the same paths. Returns its samples, and what each path has
        gathered: all, and behind its detour (``None`` without detours)."""
        first = FirstPass(self.fills_gaps) if self.flights else None
        sample = self._with(first)(scene, sampler, rays, mi.Bool(active))
        return sample, (sample.L, None) if first is None else (first.L, first.detour_L)

    def again(
        self, scene: mi.Scene, sampler: Numbers, rays: CameraRays,
        gathered: tuple[mi.Spectrum, mi.Spectrum | None], δL: mi.Spectrum | None,
        active: mi.Bool | bool = True,
    ) -> tuple[Sample, Replay]:  # fmt: skip
        """The second pass, with the random numbers of the first one: propagates derivatives. The
        parameters are as for :class:`~mitsuba_ext.transport.replay.Replay`."""
        L, detour_L = gathered
        replay = Replay(
            scene, L, δL, self.flights, self.mirrors, self.masks, self.fills_gaps, detour_L
        )
        return self._with(replay)(scene, sampler, rays, mi.Bool(active)), replay

    def _with(self, replay: FirstPass | None) -> Walk:
        walk = self.walk
        if self.rough is not None:
            walk = replace(walk, directions=MirroredDirections(walk.directions, self.rough))
        return replace(walk, replay=replay)


@dataclass
class GradientSamples:
    """The samples of a pass that computes gradients.

    Attributes:
        lanes: Their pixels.
        spp: Samples per pixel, on average.
        weight: The weight of each sample.
        sums: What the film is taken to hold when it divides by the sums of the weights;
            ``None`` for the weights of these samples.
    """

    lanes: camera.PassLanes | camera.PixelLanes
    spp: int
    weight: mi.Float | float = 1.0
    sums: mi.TensorXf | None = None

    def rays(self, sensor: mi.Sensor, sampler: Numbers) -> CameraRays:
        """Their camera rays."""
        lanes = self.lanes.lanes(sensor.film())
        numbers = camera.draw_numbers(sensor, sampler, lanes, CameraSamples())
        return camera.camera_rays(sensor, lanes, numbers, self.spp)

    def block(self, film: mi.Film) -> mi.ImageBlock:
        """An empty block for them."""
        block = film.create_block()
        block.set_coalesce(block.coalesce() and self.spp >= 4)
        return block

    def put(self, film: mi.Film, block: mi.ImageBlock, rays: CameraRays, L: mi.Spectrum) -> None:
        """Puts them, with the radiance ``L``, into a block."""
        camera.put(film, block, rays, Sample(L, mi.Bool(True)), [], self.weight)


def propagate(
    walk: ReplayedWalk, scene: mi.Scene, sensor: mi.Sensor, sampler: mi.Sampler, seed: mi.UInt32,
    samples: GradientSamples, grad_in: mi.TensorXf, optimized: Sequence[Any],
) -> None:  # fmt: skip
    """Adds the derivatives of a loss to the gradients of the parameters of ``scene``.

    Parameters:
        sampler: Seeded for the samples.
        seed: Its seed, an opaque number.
        grad_in: The derivative of the loss with respect to the image.
        optimized: The parameters that have gradients.
    """
    film, attempts = sensor.film(), itertools.count()
    with dr.resume_grad():
        before = [dr.grad(value) for value in optimized]

    def act() -> None:
        if next(attempts) > 0:
            # The first attempt, which could not be recorded, may have added something
            with dr.resume_grad():
                dr.set_grad(optimized, before)
        sums = samples.sums
        if sums is None:
            block = samples.block(film)
            _put_weights(sensor, sampler.clone(), samples, block)
            sums = block.tensor()
        of_film = _through_film(film, sums, grad_in)
        _propagate(walk, scene, sensor, sampler.clone(), seed, samples, of_film)
        dr.eval()

    # Special films may run any code when they prepare samples
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        act()
    else:
        with_recordings(scene, sensor, act)


@frozen(any_width=True)
def _put_weights(
    sensor: mi.Sensor, sampler: mi.Sampler, samples: GradientSamples, block: mi.ImageBlock
) -> None:
    samples.put(sensor.film(), block, samples.rays(sensor, sampler), dr.zeros(mi.Spectrum))


def _through_film(film: mi.Film, sums: mi.TensorXf, grad_in: mi.TensorXf) -> mi.TensorXf:
    """The derivative of the loss with respect to the ``sums`` of the film, which it divides by sums
    of weights."""
    with dr.resume_grad():
        sums = mi.TensorXf(dr.detach(sums))
        dr.enable_grad(sums)
        film.put_block(mi.ImageBlock(sums, offset=film.crop_offset()))
        of_film = _through(film.develop(), grad_in, sums)
        film.clear()
    dr.eval(of_film)
    return of_film


@frozen(any_width=True)
def _propagate(
    walk: ReplayedWalk, scene: mi.Scene, sensor: mi.Sensor, sampler: mi.Sampler, seed: mi.UInt32,
    samples: GradientSamples, of_film: mi.TensorXf,
) -> None:  # fmt: skip
    numbers, film = walk.numbers(sampler, seed), sensor.film()
    rays = samples.rays(sensor, numbers)
    with dr.resume_grad():
        L = dr.full(mi.Spectrum, 1, samples.lanes.count)
        dr.enable_grad(L)
        block = samples.block(film)
        samples.put(film, block, rays, L)
        δL = _through(block.tensor(), of_film, L)
    _follow(walk, scene, numbers, rays, δL)


@frozen(any_width=True)
def _follow(
    walk: ReplayedWalk, scene: mi.Scene, numbers: Numbers, rays: CameraRays, δL: mi.Spectrum
) -> None:
    """It is recorded alone where the sensor cannot be recorded."""
    _, gathered = walk.first(scene, numbers.clone(), rays)
    dr.eval(gathered, δL)
    walk.again(scene, numbers, rays, gathered, δL)


def _through(result: Any, derivative: Any, of: Any) -> Any:
    """The derivative of a loss with respect to ``of``, from its ``derivative`` with respect to a
    ``result``."""
    dr.set_grad(result, derivative)
    dr.enqueue(dr.ADMode.Backward, result)
    dr.traverse(dr.ADMode.Backward)
    return dr.grad(of)
