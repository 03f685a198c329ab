"""The estimator of progressive photon mapping: merging alone.

Source: T. Hachisuka, H. W. Jensen, *Stochastic Progressive Photon Mapping*, ACM Transactions on
Graphics 28(5), 2009; C. Knaus, M. Zwicker, *Progressive Photon Mapping: A Probabilistic Approach*,
ACM Transactions on Graphics 30(3), 2011 (passes are independent of each other).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ....rendering.device import device_of
from ....scene.media import may_have_grids
from ....scene.movers import movers
from ....transport.estimator import CameraRays, Sample
from ....transport.heroes import Heroes
from ....transport.numbers import Numbers
from ....transport.path_program import EndingProgram, Subpaths
from ....transport.walk import Walk
from ..choice.technique_observer import TechniqueObserver
from ..light_numbers import LightPathRays
from ..light_vertices import VertexCache
from ..light_walk import LightWalk
from ..merging.merging import MergedSubpaths
from ..merging.merging_radius import MergingRadius
from ..merging.vertex_grid import VertexGrid
from ..path_memory import bytes_of_photons
from .medium_photons import MergedOutside, PassesThrough, PhotonsInMedia, enters


class SpecularPaths(EndingProgram):
    """Ends a path where it was scattered by a lobe that is not a delta distribution. Nothing else
    finds the lights that it hits by way of mirrors and clear glass.

    Parameters:
        subpaths: The photons; ``None`` if there are none.
        enters_media: Whether a path goes on through rough boundaries of media (:func:`enters`),
            where :class:`MergedOutside` merges only photons on the side of the camera. The history
            says whether the path has crossed one.
    """

    def __init__(self, subpaths: Subpaths | None, enters_media: bool = False) -> None:
        self.subpaths, self._enters_media = subpaths, enters_media

    def begin(self, ray):
        return mi.Bool(False) if self._enters_media else None

    def leave(self, vertex, bs):
        if not self._enters_media:
            return None
        passes = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        crossed = enters(vertex, bs.wo)
        return dr.select(passes, vertex.path.history, crossed)

    def emission(self, weights, scene, si, ds, path, pdf):
        return mi.Float(1)

    def survival(self, roulette, state, vertex, path, late, active):
        goes_on = path.arrival.is_delta
        if self._enters_media:
            goes_on = goes_on | path.history
        return dr.select(goes_on, mi.Float(1), 0), state


@dataclass
class PhotonMapper:
    """Traces light paths, and camera paths up to the first vertex that they can be merged with; it
    is an :class:`Estimator`.

    Parameters:
        walk: Traces the camera paths; it makes no connections.
        light_walk: Traces the light paths.
        radius: The radius within which vertices on surfaces are merged.
        ball: The radius within which vertices in media are merged; ``None`` without media.
        light_paths: Number of light paths for each camera path; 1 in spectral variants and with
            moving shapes.
        observer: Receives the passes, and the vertices that are looked at.
    """

    walk: Walk
    light_walk: LightWalk
    radius: MergingRadius
    ball: MergingRadius | None = None
    light_paths: float = 1.0
    observer: TechniqueObserver | None = None

    @property
    def most_lanes(self) -> int:
        """The largest number of camera paths in a pass."""
        sample_bytes = bytes_of_photons(self.light_paths, self.walk.max_depth)
        return device_of(mi.Float).lanes(sample_bytes)

    def of_coarse_film(self, pixel_width: float) -> PhotonMapper:
        """The mapper for a film with fewer pixels, each as wide as ``pixel_width`` of them."""
        return replace(
            self,
            radius=self.radius.of_coarse_film(pixel_width),
            ball=self.ball and self.ball.of_coarse_film(pixel_width),
        )

    def __call__(
        self, scene: mi.Scene, sampler: Numbers, rays: CameraRays, active: mi.Bool
    ) -> Sample:
        dr.schedule(rays)
        if self.observer is not None:
            self.observer.camera(rays)
        lanes = dr.width(rays.ray)
        light = LightPathRays.of(sampler, rays, self.light_paths)
        light_walk = replace(self.light_walk, channels=self.walk.channels)
        vertices, scatter_count = light_walk.run(
            scene, light.numbers, light.time, light.wavelengths, light.emits(active)
        )
        walk, merged = self.walk, None
        if vertices is not None:
            if self.ball is not None:
                walk = replace(walk, distance=PassesThrough())
            merged = self._merged(scene, vertices, light.count)
        walk = replace(walk, program=SpecularPaths(merged, self.ball is not None))
        sample = walk(scene, sampler, rays, active)
        scatter_count = light.by_camera_path(scatter_count, lanes)
        whole = replace(sample, scatter_count=sample.scatter_count + scatter_count)
        if self.observer is not None:
            self.observer.traced(sample, whole)
        return whole

    def _merged(self, scene: mi.Scene, vertices: VertexCache, count: int) -> MergedSubpaths:
        """Adds the light of photons, from ``count`` light paths, to camera paths."""
        # If times or wavelengths differ, paths merge only with the same sample of other pixels
        groups = mi.is_spectral or bool(movers(scene))
        group = vertices.group if groups else None
        paths = min(count, self.radius.pixels) if groups else count
        radius = dr.opaque(mi.Float, self.radius.next(paths, count // paths))
        kept = None if self.ball is None else vertices.is_on_surface
        grid = VertexGrid(vertices, radius, kept, group)
        heroes, max_depth = Heroes(scene), self.walk.max_depth
        kind = MergedSubpaths if self.ball is None else MergedOutside
        merged = kind(
            vertices, grid, None, heroes, max_depth, paths, groups, None, self.observer,
            self.walk.channels,
        )  # fmt: skip
        if self.ball is None:
            return merged
        radius = dr.opaque(mi.Float, self.ball.next(paths, count // paths))
        grid = VertexGrid(vertices, radius, vertices.is_in_medium, group)
        return PhotonsInMedia(
            vertices, grid, heroes, max_depth, paths, groups, merged, self.walk.query,
            may_have_grids(scene), self.observer, self.walk.channels,
        )  # fmt: skip
