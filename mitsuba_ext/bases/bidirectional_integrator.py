"""The base class of integrators with light paths beside camera paths.

This file is executed once per variant (see ``registry.py``): its base class is variant-bound.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from ..estimators.light_paths.bidirectional_programs import LightSums
from ..estimators.light_paths.choice.candidates import Candidate
from ..estimators.light_paths.choice.light_paths import LightPathChoice, check_shared_rays
from ..estimators.light_paths.choice.technique_images import TechniqueImages
from ..estimators.light_paths.light_media import outside_of
from ..estimators.light_paths.light_side import LightSide
from ..estimators.light_paths.light_walk import LightWalk
from ..estimators.light_paths.medium_programs import LightSumsInMedia
from ..estimators.light_paths.medium_scattering import MediumTerms
from ..estimators.light_paths.merging.merging_parameters import MergingParameters, shared_numbers
from ..estimators.light_paths.merging.merging_radius import MergingRadii
from ..estimators.light_paths.partial_sums import PartialSums
from ..estimators.light_paths.path_memory import bytes_of_both_paths
from ..estimators.light_paths.path_tracer import BidirectionalPathTracer
from ..estimators.light_paths.photons.photon_mapper import PhotonMapper
from ..estimators.light_paths.scattering import SurfaceTerms
from ..images import image_files
from ..rendering.camera import film_extent
from ..rendering.device import SampleBytes, device_of
from ..rendering.request import Request
from ..rendering.stages import ReportedSchedule
from ..rendering.statistics import RenderStatistics
from ..scene.media import may_have_grids
from ..scene.movers import movers
from ..startup.registry import variant_bound
from ..transport.decisions import Decisions
from ..transport.estimator import Estimator
from ..transport.observer import Observer
from ..transport.path_decisions import EmitterSampling, NoConnections, SubpathSelection
from .learned_state import check_target
from .slots import BIDIRECTIONAL_SLOTS, read_slot
from .walk_integrator import WalkIntegrator

#: The decisions that a scene can replace, of camera paths and of light paths.
_SLOTS = ("directions", "next_event", "roulette", "shadow_test", *BIDIRECTIONAL_SLOTS)


@variant_bound
class LightPathIntegrator(WalkIntegrator):
    """Camera paths and light paths, whose vertices are connected."""

    #: See :class:`bdpt`.
    connections, light_image, sample_direct, technique_images = 1, True, True, ""
    #: Where vertices are merged; ``None`` if they are not.
    merging: MergingParameters | None = None
    #: What a render uses if no decision says that.
    techniques_by_default = Candidate(1.0, merges=True)

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.techniques: TechniqueImages | None = None

    @property
    def needs_equal_samples(self) -> str:
        if self.light_image:
            return 'its light paths find light for all pixels: set "light_image" to false'
        if self.technique_images:
            return 'its images of techniques count all samples alike: leave "technique_images" out'
        return super().needs_equal_samples

    @property
    def sample_cost(self) -> int:
        return max(3, super().sample_cost)

    @property
    def sample_bytes(self) -> SampleBytes:
        count = getattr(self.slots.get("light_paths"), "count", 1.0)
        return bytes_of_both_paths(count, self.max_depth)

    def connects_to(self, scene: mi.Scene, sensor: mi.Sensor) -> bool:
        """Whether all lights of the scene can emit light paths, and the sensor receives them."""
        try:
            outside_of(self.name, self.query(scene), scene, sensor)
            return LightSide.of(self.name, scene, sensor).sensor is not None
        except NotImplementedError:
            return False

    def merges_all(self, scene: mi.Scene) -> bool:
        """Whether all vertices are merged, or only vertices to which light comes from a delta
        lobe."""
        return False

    def estimators(self, request, spp, learning):
        self.techniques = None
        scene, film = request.scene, request.sensor.film()
        if not scene.emitters() or self.max_depth < 2:
            return self.walk
        side = LightSide.of(self.name, scene, request.sensor, self.light_image)
        check_shared_rays(self.name, scene, getattr(self.slots.get("light_paths"), "count", 1.0))
        if self.technique_images:
            self.techniques = TechniqueImages(
                film, *film_extent(film), self.max_depth, device_of(mi.Float).pass_bytes
            )
        outside = outside_of(self.name, self.query(scene), scene, request.sensor)
        radii = Once(functools.partial(self.merging_radius, request, side, outside))
        return LightPathEstimators(
            self, side, radii, self.techniques, outside, self.merges_all(scene)
        )

    def merging_radius(
        self,
        request: Request,
        side: LightSide,
        outside: mi.MediumPtr | None = None,
        next_event: EmitterSampling | None = None,
        splits: bool = False,
    ) -> MergingRadii | None:
        """Within what radii vertices of a render are merged; ``None`` if they are not. With the
        ``next_event`` and ``splits`` of its sums, its light paths have the same kernel. For
        ``outside``, see :class:`LightWalk`."""
        if self.merging is None:
            return None
        scene, in_media = request.scene, outside is not None
        sums = PartialSums(
            dr.opaque(mi.Float, 1), splits=splits, merging=dr.opaque(mi.Float, 1),
            light_paths=dr.opaque(mi.Float, 1),
            has_clear_curves=side.emission.has_clear_curves,
            terms=MediumTerms(may_have_grids(scene)) if in_media else SurfaceTerms(),
            merging_in_media=dr.opaque(mi.Float, 1) if in_media else None,
        )  # fmt: skip
        next_event = next_event or EmitterSampling()
        program = LightSums(sums, next_event)
        if in_media:
            program = LightSumsInMedia(sums, next_event, scene)
        light_walk = LightWalk(
            side.emission, self.max_depth, self.rr_depth, program, query=self.query(scene),
            outside=outside, connects=True,
        )  # fmt: skip
        return self.merging.radii_of(
            request.scene, request.sensor, light_walk, not self.merges_all(request.scene),
            request.samples_before,
        )  # fmt: skip

    def schedule(self, request, samples, learning):
        estimators = self.estimators(request, sum(samples), learning)
        planner = self.planner(request, samples, learning, estimators)
        scene = request.scene
        if isinstance(estimators, LightPathEstimators) and (mi.is_spectral or movers(scene)):
            if estimators.radii():
                planner.decide(**shared_numbers(scene, request.seed))
        if not self.technique_images:
            return planner
        return ReportedSchedule(
            planner, functools.partial(self._write_techniques, self.techniques)
        )

    def _write_techniques(
        self, images: TechniqueImages | None, statistics: RenderStatistics
    ) -> None:
        if images is not None:
            images.write(Path(self.technique_images), statistics.spp)
            return
        mi.Log(
            mi.LogLevel.Warn,
            f'"{self.name}": without lights, or with "max_depth" below 2, there are no light '
            f'paths: "{self.technique_images}" is not written.',
        )

    def render_once(self, request):
        if self.technique_images:
            check = image_files.check_exr_target
            check_target(self.name, "technique_images", self.technique_images, check)
        return super().render_once(request)


@dataclass(frozen=True)
class LightPathEstimators:
    """Makes the estimators of a render with light paths.

    Attributes:
        integrator: Has the parameters.
        side: The lights and the sensor.
        radii: Within what radii vertices are merged (:meth:`LightPathIntegrator.merging_radius`).
        images: Receives the contributions of all techniques; ``None`` if nothing does.
        outside: See :class:`LightWalk`.
        merges_all: See :meth:`LightPathIntegrator.merges_all`.
        photons: Makes the estimator with photons alone, with these ``radii``; ``None`` where they
            are no candidate.
    """

    integrator: LightPathIntegrator
    side: LightSide
    radii: Callable[..., MergingRadii | None]
    images: TechniqueImages | None = None
    outside: mi.MediumPtr | None = None
    merges_all: bool = False
    photons: Callable[..., PhotonMapper] | None = None

    def __call__(self, decisions: Decisions, observer: Observer | None = None) -> Estimator:
        integrator, side = self.integrator, self.side
        always = LightPathChoice(integrator.techniques_by_default, self.images)
        choice: LightPathChoice = decisions.light_paths or always
        techniques = choice.techniques
        if techniques.alone:
            return self.photons(radii=self.radii())
        are_traced = techniques.light_paths > 0
        next_event = decisions.next_event
        if not integrator.sample_direct:
            next_event = NoConnections()
        elif are_traced:
            next_event = side.next_event(next_event)
        else:
            next_event = next_event or side.correct
        walk = integrator.walk(replace(decisions, next_event=next_event), observer)
        if not are_traced:
            return walk
        radii = None
        if techniques.merges:
            compares = choice.observer is not None and choice.observer.compares
            radii = self.radii(walk.next_event, compares)
        if radii is not None and choice.pixel_width > 1:
            radii = radii.of_coarse_film(choice.pixel_width)
        sample_bytes = bytes_of_both_paths(techniques.light_paths, integrator.max_depth)
        tracer = BidirectionalPathTracer(
            walk, side.emission, side.sensor, integrator.connections * techniques.connections,
            decisions.subpath_selection or SubpathSelection(), choice.observer, radii=radii,
            merges_all=self.merges_all, light_paths=techniques.light_paths,
            most_lanes=device_of(mi.Float).lanes(sample_bytes), outside=self.outside,
        )  # fmt: skip
        if choice.photons is None:
            return tracer
        return choice.photons.beside(tracer, self.photons(radii=self.radii()))


@variant_bound
class BidirectionalIntegrator(LightPathIntegrator):
    """A :class:`LightPathIntegrator` with the parameters of :class:`bdpt`."""

    has_light_paths = light_paths_see_media = True

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.connections = self.parameter(props, "connections", 1, minimum=0, maximum=1024)
        self.light_image = self.parameter(props, "light_image", True)
        self.sample_direct = self.parameter(props, "sample_direct", True)
        self.technique_images = self.parameter(props, "technique_images", "", none="none")
        self.fill(props, **{slot: read_slot(self.name, props, slot) for slot in _SLOTS})
        without_direct = ("next_event", "shadow_test", "light_paths")
        without_images = ("light_paths",) if self.technique_images else ()
        for key, refused in (
            ("sample_direct", () if self.sample_direct else without_direct),
            ("technique_images", without_images),
        ):
            for slot in self.slots.keys() & set(refused):
                raise ValueError(
                    f'"{self.name}": the parameter "{slot}" cannot be combined with '
                    f'"{key} = {getattr(self, key)}"; leave it out'
                )
        if self.technique_images and self.checkpoint:
            raise ValueError(
                f'"{self.name}": "technique_images" and "checkpoint" exclude each other: the '
                f"images are those of one render"
            )
        if self.technique_images and not self.technique_images.endswith(".exr"):
            raise ValueError(
                f'"{self.name}": "technique_images" is "{self.technique_images}"; the name of the '
                f'file must end with ".exr"'
            )

    def parameters(self) -> dict[str, Any]:
        return {"light_paths": "always", **super().parameters()}


class Once:
    """A function that is called once, when its result is first needed."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function: Callable[..., Any] | None = function
        self._result: Any = None

    def __call__(self, *arguments: Any) -> Any:
        if self._function is not None:
            self._result, self._function = self._function(*arguments), None
        return self._result
