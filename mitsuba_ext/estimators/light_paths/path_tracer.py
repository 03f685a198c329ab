"""The estimator of bidirectional path tracing."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ...scene.media import may_have_grids
from ...scene.movers import movers
from ...transport.estimator import CameraRays, Sample
from ...transport.frozen import frozen
from ...transport.heroes import Heroes
from ...transport.numbers import BothEnds, Numbers, copied, go_to, reached
from ...transport.observer import Observers
from ...transport.path_decisions import SubpathSelection
from ...transport.path_program import PathProgram
from ...transport.walk import Walk
from ...transport.without_lengths import WithoutLengths
from .bidirectional_programs import BidirectionalProgram, LightSums
from .choice.candidates import Available
from .choice.technique_observer import TechniqueObserver
from .connections import LightSubpaths
from .emission import LightEmission
from .light_image import LightImage
from .light_numbers import LightPathRays
from .light_walk import LightWalk
from .medium_programs import BidirectionalProgramInMedia, LightSumsInMedia
from .medium_scattering import MediumTerms
from .merging.merging import PHOTONS_PER_DISK, MergedSubpaths, disk_area
from .merging.merging_in_media import PHOTONS_PER_SAMPLE, MergedInMedia, ball_volume
from .merging.merging_radius import MergingRadii
from .merging.vertex_grid import VertexGrid, all_of
from .partial_sums import PartialSums
from .scattering import SurfaceTerms
from .sensor import ConnectableSensor
from .vertex_choice import OwnVertexChoice, RegionChoice, VertexChoice

#: The number of vertices of a light path that MIS weights assume. The true number would make the
#: weights depend on the samples. (door_ajar: 11 % less variance than with 1.)
_VERTICES = 2.5

#: The number of connections that MIS weights assume where there are none. It is not 0 because it is
#: a factor of dVCM, and a dVCM of 0 means a delta lobe.
_NONE = 1e-9


@dataclass
class BidirectionalPathTracer:
    """Traces a camera path and a light path in each lane; it is an :class:`Estimator`. A
    :class:`Walk` with any decisions traces the camera path.

    Parameters:
        walk: Traces the camera paths.
        emission: Samples the rays with which light paths begin.
        sensor: The sensor to which light paths are connected; ``None`` to leave out this technique.
        connections: Number of light path vertices to which each camera path vertex is connected, or
            0.
        selection: Chooses the regions from which these vertices are taken. Paths of different
            wavelengths or times cannot be connected. Where these differ between lanes, the choice
            is always uniform among the vertices of the light path in the same lane.
        observer: Receives the contributions of each technique, also from the walk.
        is_alone: Whether the sample in a lane must not depend on other lanes. If so, a camera path
            is connected only to the light path in its lane.
        skips_direct: Whether paths of one and two segments are left out.
        radii: The radii within which vertices are merged; ``None`` if they are not.
        merges_all: See :class:`PartialSums`.
        light_paths: Number of light paths for each camera path. It must be 1 where paths of
            different lanes cannot be connected (see ``selection`` and ``is_alone``).
        most_lanes: The largest number of lanes for which the memory of stored vertices suffices; 0
            for any number.
        outside: See :class:`LightWalk`.
    """

    walk: Walk
    emission: LightEmission
    sensor: ConnectableSensor | None
    connections: int
    selection: SubpathSelection = field(default_factory=SubpathSelection)
    observer: TechniqueObserver | None = None
    is_alone: bool = False
    skips_direct: bool = False
    radii: MergingRadii | None = None
    merges_all: bool = False
    light_paths: float = 1.0
    most_lanes: int = 0
    outside: mi.MediumPtr | None = None

    def __call__(
        self, scene: mi.Scene, sampler: Numbers, rays: CameraRays, active: mi.Bool
    ) -> Sample:
        walk = self.walk
        own_lane = self.is_alone or mi.is_spectral or bool(movers(scene))
        selects = self.selection.count > 0 and self.connections > 0 and not own_lane
        selection = self.selection if selects else None
        # Connections per vertex of a light path. A selection itself divides by the number of
        # vertices, in ``expected``
        count = self.connections if selection else self.connections / _VERTICES or _NONE
        observer, splits = self.observer, False
        if observer is not None:
            observer.start(rays, Available(
                self.sensor is not None, self.connections > 0, self.radii, not own_lane,
                self.most_lanes,
            ))  # fmt: skip
            walk = replace(walk, observer=Observers([walk.observer, observer]))
            splits = observer.compares
        lanes = dr.width(rays.ray)
        light = LightPathRays.of(sampler, rays, self.light_paths)
        per_camera_path = light.count / lanes
        # Light paths scatter in media
        in_media = self.outside is not None
        terms = MediumTerms(may_have_grids(scene)) if in_media else SurfaceTerms()
        disk, ball, merging, merging_in_media = None, None, None, None
        if self.radii is not None:
            # If times or wavelengths differ, paths merge only with the same sample of other pixels
            paths = min(lanes, self.radii.pixels) if own_lane else light.count
            disk, ball = self._next_radii(paths, light.count // paths)
            merging = mi.Float(0)
            if disk is not None:
                merging = disk_area(disk) * dr.opaque(mi.Float, paths / PHOTONS_PER_DISK)
            if in_media:
                merging_in_media = mi.Float(0)
            if ball is not None:
                share = dr.opaque(mi.Float, paths / PHOTONS_PER_SAMPLE)
                merging_in_media = ball_volume(ball) * share
        sums = PartialSums(
            dr.opaque(mi.Float, count), splits=splits, selection=selection, merging=merging,
            merges_all=self.merges_all, light_paths=dr.opaque(mi.Float, per_camera_path),
            has_clear_curves=self.emission.has_clear_curves, terms=terms,
            merging_in_media=merging_in_media,
        )  # fmt: skip
        image = None
        if self.sensor is not None:
            numbers = sampler if light.count == lanes else light.numbers
            image = LightImage(
                scene, self.sensor, numbers, rays, sums, walk.query, walk.hide_emitters,
                2 if self.skips_direct else 1, observer, per_camera_path, walk.channels,
                terms,
            )  # fmt: skip
        light_program = LightSums(sums, walk.next_event)
        if in_media:
            light_program = LightSumsInMedia(sums, walk.next_event, scene)
        light_walk = LightWalk(
            self.emission, walk.max_depth, walk.rr_depth, light_program, query=walk.query,
            outside=self.outside, connects=True, channels=walk.channels,
        )  # fmt: skip
        # Evaluated now, since later kernels of the pass read the rays again
        dr.schedule(rays)
        vertices, scatter_count = light_walk.run(
            scene, light.numbers, light.time, light.wavelengths, light.emits(active)
        )
        splats, subpaths = [], None
        if vertices is not None:
            if image is not None:
                splats.append(image.splats(vertices))
            if selection is not None:
                choice = RegionChoice(vertices, selection)
            else:
                choice = OwnVertexChoice(vertices) if own_lane else VertexChoice(vertices)
            if self.connections > 0:
                subpaths = LightSubpaths(
                    scene, vertices, choice, sums, walk.query, self.connections, walk.max_depth,
                    walk.observer, observer, walk.channels,
                )  # fmt: skip
            merged = functools.partial(self._merged, scene, vertices, sums, own_lane, in_media)
            if disk is not None:
                subpaths = merged(MergedSubpaths, disk, paths, subpaths)
            if ball is not None:
                subpaths = merged(MergedInMedia, ball, paths, subpaths)
        kind = BidirectionalProgramInMedia if in_media else BidirectionalProgram
        program: PathProgram = kind(
            scene, sums, self.emission, self.sensor, observer, subpaths
        )
        if self.skips_direct:
            program = WithoutLengths(program, 1, 2)
        if isinstance(sampler, BothEnds):
            sampler = sampler.camera
        sample = camera_paths(replace(walk, program=program), scene, sampler, rays, active)
        # The first lane counts all rays that belong to no camera path
        is_first = dr.arange(mi.UInt32, lanes) == 0
        shadow_count = sample.shadow_count
        if image is not None:
            shadow_count = shadow_count + dr.select(is_first, image.shadow_count, 0)
        scatter_count = light.by_camera_path(scatter_count, lanes)
        whole = replace(
            sample, splats=splats, scatter_count=sample.scatter_count + scatter_count,
            shadow_count=shadow_count,
        )  # fmt: skip
        if observer is not None:
            observer.traced(sample, whole)
        return whole

    def _next_radii(self, paths: int, groups: int) -> list[mi.Float | None]:
        """The radii of disks and balls of the next pass; see :meth:`MergingRadius.next`."""
        return [
            radius and dr.opaque(mi.Float, radius.next(paths, groups))
            for radius in (self.radii.disk, self.radii.ball)
        ]

    def _merged(
        self, scene, vertices, sums, own_lane, in_media, kind, radius, paths, others
    ) -> MergedSubpaths:
        """Merges vertices on surfaces, or in media, within ``radius``; ``kind`` is the class."""
        where = None
        if in_media:
            where = vertices.is_in_medium if kind is MergedInMedia else vertices.is_on_surface
        kept = all_of(where, None if self.merges_all else vertices.is_caustic)
        grid = VertexGrid(vertices, radius, kept, vertices.group if own_lane else None)
        more = {"query": self.walk.query} if kind is MergedInMedia else {}
        return kind(
            vertices, grid, sums, Heroes(scene), self.walk.max_depth, paths, own_lane, others,
            self.observer, self.walk.channels, **more,
        )  # fmt: skip


def camera_paths(
    walk: Walk, scene: mi.Scene, sampler: Numbers, rays: CameraRays, active: mi.Bool
) -> Sample:
    """The samples of ``walk``. Its kernels are recorded unless its observer forbids that."""
    if not walk.observer.can_be_frozen:
        return walk(scene, sampler, rays, active)
    sample, place = _walked(walk, scene, sampler, rays, mi.Bool(active))
    go_to(sampler, place)
    return sample


@frozen
def _walked(walk: Walk, scene, sampler, rays, active) -> tuple[Sample, Any]:
    numbers = copied(sampler)
    return walk(scene, numbers, rays, active), reached(numbers)
