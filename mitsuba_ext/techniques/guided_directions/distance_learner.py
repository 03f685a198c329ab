"""Learns the distances of flights in media, beside guided directions."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...planning.costs import GUIDED_FLIGHTS
from ...planning.evidence import BATCHES, gain_of
from ...planning.learner import Learner, Pilot
from ...planning.prediction import Effect, Prediction
from ...scene.media import may_have_grids
from ...transport.queries.scene import scene_query
from ...util.arrays import from_numpy
from ...util.stored_arrays import StoredArrays
from .guided_distances import GuidedDistances
from .learner import GuideLearner
from .path_records import PathRecords
from .regions_with_media import RegionsWithMedia
from .scattered_light import RESOLUTION, Box, DirectLight, ScatteredLight


class DistanceLearner(Learner):
    """Learns from the records of a learner of directions, which precedes this one, in its regions.
    Distances are given up where pilots show that they do not pay, or that no directions are guided.

    Parameters:
        guide: The learner of directions, by regions of surfaces and media.
        time: The time at which direct light is computed.
        always: Guide distances also where they do not pay?

    Attributes:
        decision (GuidedDistances): What was learned; ``None`` where nothing is guided.
        gain: The relative reduction of variance in the pilots.
    """

    def __init__(self, guide: GuideLearner, time: float, always: bool) -> None:
        self._guide, self._time, self._always = guide, time, always
        self.decision: GuidedDistances | None = None
        self.gain: float | None = None
        self._direct: DirectLight | None = None
        self._evidence: np.ndarray | float = 0.0
        self._medium: mi.UInt32 | None = None
        guide.learn_flights(self)

    def start(
        self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f
    ) -> GuidedDistances | None:
        regions = self._guide.regions
        if regions is None:
            return None
        self._box = Box(regions.media.origin, regions.media.size)
        self._direct = DirectLight(self._box)
        # The medium of each region
        self._medium = dr.zeros(mi.UInt32, regions.tree_count)
        dr.make_opaque(self._medium)
        # As ``path``, but with the kernel of the pilots that follow
        unknown = dr.full(mi.Float, -1, regions.tree_count)
        light = ScatteredLight.unknown(self._box)
        self.decision = GuidedDistances(light, regions, unknown, self._flights)
        return self.decision

    @property
    def _flights(self) -> int:
        # Before and after each bounce that may be guided
        return self._guide.bounces + 1

    # ---- Observer ----

    def kernel_state(self) -> tuple:
        """The attributes on which kernels depend (``frozen.py``)."""
        return (self._medium,)

    def direction(self, vertex, sample, weight, L, active) -> None:
        if self._medium is None or vertex.medium is None:
            return
        active = active & vertex.medium.scatters
        region = self._guide.regions.label(vertex.si, None, active)
        medium = dr.reinterpret_array(mi.UInt32, vertex.medium.mei.medium)
        # Where several media share a region, the largest index, so that the order does not matter
        dr.scatter_reduce(dr.ReduceOp.Max, self._medium, medium, region, active)

    # ---- Between the stages ----

    def update(self, pilot: Pilot, regions: RegionsWithMedia, records: PathRecords) -> None:
        """Learns from all records, of which those from ``first_new`` on are the last pilot's."""
        if self.decision is None:
            return
        if self._direct.points > 0 and records.count > records.first_new:
            self._evidence = self._evidence + self._sums(records)
            self.gain, error = gain_of(self._evidence)
            # Until the last pilot, learning goes on if distances may pay
            least = (1 - self.gain) * np.exp(0 if pilot.is_last else -error)
            share = self._guide.known
            prediction = Prediction(least, GUIDED_FLIGHTS, error, share, grows=True)
            if not (self._always or pilot.pays(prediction)):
                self.decision = self._direct = self._medium = None
                return
        elif self._guide.guidance is None and not pilot.is_last:
            # Whether directions are guided is not known yet
            return
        centre = mi.Point3f(0.5)
        voxel = dr.arange(mi.UInt32, RESOLUTION**3)
        region = regions.of_media(self._box.point(voxel, centre))
        medium = dr.reinterpret_array(mi.MediumPtr, dr.gather(mi.UInt32, self._medium, region))
        scene = pilot.scene
        self._direct.add(scene, scene_query(scene), medium, may_have_grids(scene), self._time)
        # What media scatter more than once; nothing where it is unknown
        indirect = dr.maximum(regions.incident_radiance(records), 0)
        values = self._direct.mean + dr.gather(mi.Float, indirect, region)
        outside = dr.gather(mi.Float, indirect, regions.of_media(mi.Point3f(dr.inf)))
        samples = records.samples
        samples.value, samples.throughput = samples.found, samples.carried
        surfaces = regions.incident_radiance(samples)
        light = ScatteredLight(self._box, values, outside)
        self.decision = GuidedDistances(light, regions, surfaces, self._flights)

    def _sums(self, records: PathRecords) -> np.ndarray:
        """For each batch of the last pilot's paths: the variance, and what distances have saved."""
        square, variances = records.squares(records.found)
        new = dr.arange(mi.UInt32, len(square)) + dr.opaque(mi.UInt32, records.first_new)
        # The mean of value² / weight is the second moment of uniform numbers
        saved = square * (dr.rcp(dr.gather(mi.Float, records.flight, new)) - 1)
        sums = dr.zeros(mi.Float64, BATCHES)
        batch = dr.gather(mi.UInt32, records.batch, new)
        dr.scatter_add(sums, mi.Float64(saved), batch, dr.isfinite(saved))
        return np.stack([variances, sums.numpy()])

    def learn(self, pilot: Pilot) -> GuidedDistances | None:
        if self._guide.guide is None:
            self.decision = self._direct = self._medium = None
        return self.decision

    def finish(self) -> None:
        self._direct = self._medium = None

    def state(self) -> dict[str, np.ndarray]:
        if self.decision is None:
            return {}
        light = self.decision.light
        return {
            "origin": light.box.origin, "size": light.box.size, "values": light.values.numpy(),
            "outside": light.outside.numpy(), "surfaces": self.decision.surfaces.numpy(),
            "flights": np.array(self.decision.flights),
        }  # fmt: skip

    def restore(self, scene: mi.Scene, state: StoredArrays) -> GuidedDistances:
        regions = self._guide.guide.regions
        box = Box(state.take("origin", "f", (3,)), state.take("size", "f", (3,), least=0))
        values = state.take("values", "f", (RESOLUTION**3,), least=0)
        outside = state.take("outside", "f", (1,), least=-1)
        surfaces = state.take("surfaces", "f", (regions.tree_count,), least=-1)
        flights = state.number("flights", "iu", 1, 1 << 20)
        light = ScatteredLight(box, from_numpy(mi.Float, values), from_numpy(mi.Float, outside))
        surfaces = from_numpy(mi.Float, surfaces)
        self.decision = GuidedDistances(light, regions, surfaces, flights)
        return self.decision

    @property
    def effect(self) -> Effect | None:
        if self.gain is None:
            return None if self.decision is None else Effect(True)
        return Effect(self.decision is not None, 1 - self.gain, GUIDED_FLIGHTS)

    def __str__(self) -> str:
        if self.gain is None:
            return ""
        kept = "distances in media" if self.decision is not None else "no distances in media"
        return f"{kept}: about {max(self.gain, 0):.0%} less variance"


class UnguidedGrids(Learner):
    """Says that distances in grids are not guided. Delta tracking draws many numbers for a flight,
    and the first of them decides little.

    Parameters:
        guide: The learner of directions.
    """

    def __init__(self, guide: GuideLearner) -> None:
        self._guide = guide

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> None:
        return None

    def learn(self, pilot: Pilot) -> None:
        return None

    def __str__(self) -> str:
        return "distances in grids are not guided" if self._guide.guide is not None else ""
