"""The estimator of instant radiosity: camera paths that are connected to virtual point lights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi

from ....transport.estimator import CameraRays, Sample
from ....transport.numbers import Numbers
from ....transport.observer import Observers
from ....transport.path_decisions import SubpathSelection
from ....transport.walk import Walk
from ..light_walk import LightWalk
from ..path_tracer import camera_paths
from ..photons.photon_history import RegionProgram
from .virtual_light_bound import Bound, CompensatingPaths
from .virtual_light_choice import LearnedChoice, UniformChoice, VirtualLightChoice
from .virtual_light_connections import VirtualLightConnections
from .virtual_light_parts import LightParts, PictureOfLights
from .virtual_lights import Sets, VirtualLights


@dataclass
class Tally:
    """Counts what a render has traced.

    Attributes:
        lights, sets: Number of virtual lights, and of sets.
    """

    lights: int = 0
    sets: int = 0


@dataclass
class InstantRadiosity:
    """Traces light paths, whose vertices become virtual lights, and connects camera paths to them;
    it is an :class:`Estimator`.

    Parameters:
        walk: Traces the camera paths, with the decisions of ``path``.
        light_walk: Traces the light paths.
        sets: How samples share virtual lights.
        bound: Bounds what a connection adds.
        connections: Number of connections of a vertex.
        choice: Makes the choice of virtual lights, from these, the set of each lane, and the bound.
        selection: Chooses regions of virtual lights instead, if it has any.
        tally: Counts.
        picture: Shows the virtual lights. If there is one, the samples' output variables are the
            parts of :class:`LightParts`, and the picture.
    """

    walk: Walk
    light_walk: LightWalk
    sets: Sets
    bound: Bound
    connections: int
    choice: Callable[..., VirtualLightChoice] = UniformChoice
    selection: SubpathSelection = field(default_factory=SubpathSelection)
    tally: Tally = field(default_factory=Tally)
    picture: PictureOfLights | None = None

    def __call__(
        self, scene: mi.Scene, sampler: Numbers, rays: CameraRays, active: mi.Bool
    ) -> Sample:
        # Evaluated now, since later kernels of the pass read the rays again
        dr.schedule(rays)
        lanes = dr.width(rays.ray)
        selection = self.selection if self.selection.count > 0 else None
        light_walk = self.light_walk
        if selection is not None:
            light_walk = replace(light_walk, program=RegionProgram(selection))
        set_count = self.sets.count(lanes)
        lights, scatter_count = VirtualLights.trace(
            scene, light_walk, sampler, rays, set_count, self.sets.paths
        )
        self.tally.sets += set_count
        walk, subpaths = self.walk, None
        parts = LightParts(self.bound) if self.picture is not None else None
        if parts is not None:
            walk = replace(walk, observer=Observers([walk.observer, parts]))
        if lights is not None:
            self.tally.lights += lights.vertices.count
            if selection is not None:
                choice = LearnedChoice(lights, selection)
            else:
                choice = self.choice(lights, self.sets.of_lanes(rays), self.bound.largest)
            subpaths = VirtualLightConnections(
                scene, lights.vertices, choice, self.bound, walk.query, self.connections,
                walk.max_depth, walk.observer, parts,
            )  # fmt: skip
        walk = replace(walk, program=CompensatingPaths(self.bound, selection, subpaths))
        sample = camera_paths(walk, scene, sampler, rays, active)
        if parts is not None:
            # The sums of the parts are complete when the kernel of the samples has run
            dr.eval(sample)
            values = [part * rays.importance for part in parts.values()]
            values.append(self.picture.values(scene, lights, walk, sampler, rays))
            sample = replace(sample, aovs=[channel for value in values for channel in value])
        # The first lane counts the rays of light paths
        is_first = dr.arange(mi.UInt32, lanes) == 0
        scatter_count = dr.select(is_first, dr.sum(scatter_count), 0)
        return replace(sample, scatter_count=sample.scatter_count + scatter_count)
