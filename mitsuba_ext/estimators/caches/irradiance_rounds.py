"""Makes the records of an irradiance cache for one camera, in rounds.

In each round, camera rays through a part of the pixels find places that no record covers; some of
them, none close to another, get a record. Later rounds look at more pixels, until all are covered.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ...rendering import camera
from ...rendering.pass_samples import look
from ...transport.decisions import CameraSamples
from ...transport.path_decisions import NoConnections
from ...transport.walk import Walk
from ...util.arrays import from_numpy
from ..light_paths.merging.merging import scene_diagonal
from .cached_light import FindsPlaces
from .choice import chosen
from .gathering import Gatherer
from .record_grid import RecordGrid
from .records import Places, Records

#: The distance of the pixels of the first round; the most rounds in which all pixels take part, and
#: the share of uncovered pixels at which the last one ends.
_FIRST_STRIDE, _FULL_ROUNDS, _FEW = 16, 5, 1e-3

#: Records are valid this much farther in the image than where they are placed: more of them
#: overlap, which smooths their noise. (cornell_box: 0.9 of the error of 1.0; 2.0 takes twice as
#: long.)
_OVERLAP = 1.3

#: The side of the grid of film positions that measures how wide pixels are.
_PROBES = 16


@dataclass(frozen=True)
class CacheParameters:
    """What decides how many records there are.

    Attributes:
        accuracy: a of Eq. 10.9.
        min_spacing, max_spacing: The smallest and the largest radius in which a record is valid, in
            pixels.
    """

    accuracy: float
    min_spacing: float
    max_spacing: float

    @property
    def bounds(self) -> tuple[float, float]:
        """The smallest and the largest reach of a record, in pixels."""
        return self.min_spacing / self.accuracy, self.max_spacing / self.accuracy


@dataclass
class Round:
    """What one round did.

    Attributes:
        asked: Number of camera paths that asked the cache.
        uncovered: How many of them found no record.
        made: Number of records that were made.
    """

    asked: int
    uncovered: int
    made: int


class CacheRounds:
    """Makes records.

    Parameters:
        scene: The scene.
        sensor: The camera.
        walk: The walk of camera paths; its decisions about lights do not matter.
        gatherer: Makes the records.
        parameters: Determine how many records there are.
        seed: Seed of the render.
        records: The records that exist.
        most: The largest number of records to make.

    Attributes:
        records: The records so far.
        rounds: What each round did.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        walk: Walk,
        gatherer: Gatherer,
        parameters: CacheParameters,
        seed: int,
        records: Records,
        most: int,
    ) -> None:
        self._scene, self._sensor, self._gatherer = scene, sensor, gatherer
        self._parameters, self._seed, self.records, self._left = parameters, seed, records, most
        self.rounds: list[Round] = []
        self._grid = RecordGrid(records, parameters.accuracy)
        self._walk = Walk(
            walk.max_depth, walk.rr_depth, walk.hide_emitters, query=walk.query,
            next_event=NoConnections(),
        )  # fmt: skip
        self._apart, self._angle = pixel_cone(scene, sensor)

    def run(self, goes_on: Callable[[], bool]) -> None:
        """Runs the rounds, as long as ``goes_on`` says so."""
        stride = _FIRST_STRIDE
        while stride > 1 and self._left and goes_on():
            self._round(stride)
            stride //= 2
        for _ in range(_FULL_ROUNDS):
            if not goes_on() or not self._left:
                return
            done = self._round(1)
            if done.uncovered <= _FEW * done.asked:
                return

    def final_grid(self) -> RecordGrid:
        """The records that the image uses."""
        return RecordGrid(self.records, _OVERLAP * self._parameters.accuracy)

    def _round(self, stride: int) -> Round:
        places, asked = self._uncovered(stride)
        p = self._parameters
        index = chosen(places, self.records, p.accuracy, p.bounds, len(self.rounds))
        if len(index) > self._left:
            # A random part of them
            order = np.random.default_rng(len(self.rounds)).permutation(len(index))
            index = np.sort(index[order[: self._left]])
        self._left -= len(index)
        if len(index):
            made = self._gatherer.records(places[index])
            self.records = self.records.joined(made).adapted(p.accuracy)
            self._grid = RecordGrid(self.records, p.accuracy)
        self.rounds.append(Round(asked, len(places), len(index)))
        return self.rounds[-1]

    def _uncovered(self, stride: int) -> tuple[Places, int]:
        """Places where camera paths find no record, and the number of paths that asked."""
        film = self._sensor.film()
        width, height = camera.film_extent(film)
        # Another place in each cell of the coarse grid for each round
        offset = len(self.rounds) * stride // 3 % stride
        x, y = np.meshgrid(
            np.minimum(np.arange(0, width, stride) + offset, width - 1),
            np.minimum(np.arange(0, height, stride) + offset, height - 1),
        )
        lanes = camera.PixelLanes(from_numpy(mi.UInt32, (y * width + x).ravel()))
        sampler = mi.load_dict({"type": "independent"})
        seed = mi.sample_tea_32(mi.UInt32(self._seed), mi.UInt32(len(self.rounds) + 0x20000))[0]
        sampler.seed(dr.opaque(mi.UInt32, seed[0]), lanes.count)
        finds = FindsPlaces(self._grid, self._walk.max_depth, lanes.count)
        walk = replace(self._walk, program=finds)
        dr.eval(look(walk, CameraSamples(), self._scene, self._sensor, sampler, lanes, 1))
        asks, covered = finds.asks.numpy(), finds.covered.numpy()
        arrays = (np.array(v).T for v in (finds.p, finds.n, finds.geometric))
        places = Places(*arrays, self._apart + self._angle * finds.length.numpy())
        valid = np.isfinite(places.p).all(axis=1) & np.isfinite(places.n).all(axis=1)
        valid &= np.isfinite(places.footprint) & (places.footprint > 0)
        return places[np.flatnonzero(asks & ~covered & valid)], int(asks.sum())


def pixel_cone(scene: mi.Scene, sensor: mi.Sensor) -> tuple[float, float]:
    """The width of a pixel's rays where they leave the camera, and the angle by which they widen:
    medians over the film. For sensors without ray differentials, the width of a pixel is a
    thousandth of the scene."""
    lane = dr.arange(mi.UInt32, _PROBES**2)
    position = (mi.Point2f(lane % _PROBES, lane // _PROBES) + 0.5) / _PROBES
    ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, position, mi.Point2f(0.5))
    if ray.has_differentials:
        apart = np.median(np.atleast_1d(dr.norm(ray.o_x - ray.o).numpy()))
        angle = np.median(np.atleast_1d(dr.norm(ray.d_x - ray.d).numpy()))
        if np.isfinite(apart + angle) and apart + angle > 0:
            return float(apart), float(angle)
    return scene_diagonal(scene) / 1000, 0.0


def deadline(seconds: float, start: float) -> Callable[[], bool]:
    """A function that returns whether time is left. ``seconds`` of 0 or less mean no limit."""
    return lambda: seconds <= 0 or time.perf_counter() - start < seconds
