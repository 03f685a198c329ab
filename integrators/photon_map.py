"""Photon mapping in two passes, with a final gather."""

from __future__ import annotations

import functools
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from mitsuba_ext.bases.slots import read_slot
from mitsuba_ext.bases.walk_integrator import WalkIntegrator
from mitsuba_ext.estimators.light_paths.light_side import light_emission
from mitsuba_ext.estimators.light_paths.light_walk import LightWalk
from mitsuba_ext.estimators.light_paths.merging.merging import median_footprint
from mitsuba_ext.estimators.light_paths.photons.gathering_paths import (
    ENDED,
    GATHERS_ON,
    GatheringPaths,
    first_vertex,
    is_diffuse,
)
from mitsuba_ext.estimators.light_paths.photons.photon_directions import PhotonDirections
from mitsuba_ext.estimators.light_paths.photons.photon_maps import (
    PhotonMaps,
    PhotonSubpaths,
    photon_walk,
)
from mitsuba_ext.scene.bsdfs import refuse_clear_curves
from mitsuba_ext.scene.movers import refuse_to_share
from mitsuba_ext.startup import registry
from mitsuba_ext.transport.decisions import Decisions
from mitsuba_ext.transport.observer import Observer
from mitsuba_ext.transport.walk import Walk

#: The names of the maps, in the order in which they are made.
_MAPS = ("caustic", "global")


@registry.plugin
class PhotonMapping(WalkIntegrator):
    r"""
    .. _integrator-photon_map:

    Photon mapping (:monosp:`photon_map`)
    -------------------------------------

    Traces photons once, before the render. Camera paths then end early: the light that leaves the
    second diffuse surface of a path, and the caustics that fall on the first, are estimated from
    nearby photons. Direct light is sampled as in :monosp:`path`.

    .. pluginparameters::

     * - photons
       - |int|
       - Number of light paths. (Default: 250000)
     * - final_gather
       - |bool|
       - Whether one more segment from the first diffuse surface finds indirect light. If not, the
         global map is shown there directly, with less noise, but blotches. (Default: true)
     * - guided
       - |bool|
       - Whether half of the segments of the final gather follow the directions from which photons
         have come. This takes longer, and seldom pays. (Default: false)
     * - lookup_size
       - |int|
       - Number of photons that an estimate should use; it determines the radii that are 0.
         (Default: 30)
     * - global_radius, caustic_radius
       - |float|
       - Radius within which photons of the two maps are looked up, in units of the scene. (Default:
         0: the most suitable of four radii, by the photons around the place)
     * - photon_aovs
       - |bool|
       - Whether to write the estimates of the two maps alone, for the surface that a pixel shows,
         to the channels :monosp:`global.R`, :monosp:`caustic.R`, … (Default: false)
     * - next_event, shadow_test
       - |string| or decision
       - How lights are chosen for direct light; see :class:`composed_path`.
     * - (Common parameters)
       - |several|
       - The parameters of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout,
         aovs, checkpoint.

    **Use it when** you want a smooth preview, within seconds, of a scene with indirect light and
    caustics. **Not when** the image must be right: :class:`vcm` and :class:`sppm` converge, and
    this integrator does not.

    The image is biased with any number of samples: photons are traced once, and light is blurred
    over the radius, which does not shrink. More photons make the radius smaller. An estimate uses
    the photons within one of four radii (1, 2, 4 and 8 times the radius that suits dense photons)
    instead of the k nearest photons: the loop then needs no heap, and estimates still adapt.

    Photons are stored where a BSDF has a diffuse lobe. Glossy surfaces without one (rough metal and
    glass) scatter camera paths and photons as mirrors do, so reflections in them stay sharp.

    Spectral variants, moving shapes and participating media are refused, because photons of
    different wavelengths and times cannot be merged. Curves whose BSDF transmits light, such as
    :monosp:`hair`, are refused, because photons do not pass through them (use :class:`vcm`).
    Gradients are not supported (use :class:`composed_prb`), and neither is nesting in
    :monosp:`moment` and :monosp:`aov`.

    Source: H. W. Jensen et al., *State of the Art in Monte Carlo Global Illumination*, SIGGRAPH
    course, 2004, section 10.5; D. Cline, PhD thesis, 2007, section 7.7.

    .. tabs::
        .. code-tab:: xml

            <integrator type="photon_map">
                <integer name="photons" value="1000000"/>
            </integrator>

        .. code-tab:: python

            'type': 'photon_map',
            'photons': 1000000
    """

    no_expressions = (
        'its photons are gathered once for light of all kinds; use "sppm" or "vcm"'
    )
    has_light_paths = True

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.photons = self.parameter(props, "photons", 250_000, minimum=1, maximum=1 << 24)
        self.final_gather = self.parameter(props, "final_gather", True)
        self.guided = self.parameter(props, "guided", False)
        if self.guided and not self.final_gather:
            raise ValueError(
                f'"{self.name}": "guided" chooses the directions of the final gather, which '
                f'"final_gather" switches off: leave one of them out'
            )
        self.lookup_size = self.parameter(props, "lookup_size", 30, minimum=1)
        self.radii = {
            name: self.parameter(props, f"{name}_radius", 0.0, none="automatic", minimum=0.0)
            for name in _MAPS
        }
        self.photon_aovs = self.parameter(props, "photon_aovs", False)
        #: The photons of the last render (:class:`PhotonMaps`).
        self.maps = PhotonMaps()
        slots = {key: read_slot(self.name, props, key) for key in ("next_event", "shadow_test")}
        self.fill(props, **slots)

    def _traced(self, scene: mi.Scene, sensor: mi.Sensor, seed: int) -> PhotonMaps:
        query = self.query(scene)
        refuse_to_share(
            scene, self.name,
            'photons of other wavelengths and times cannot be merged; use "sppm" or "vcm"',
        )  # fmt: skip
        if not scene.emitters() or self.max_depth < 2:
            return PhotonMaps()
        refuse_clear_curves(scene, f'"{self.name}"')
        emission = light_emission(self.name, scene)
        walk = photon_walk(LightWalk(emission, self.max_depth, self.rr_depth, query=query))
        return PhotonMaps.trace(
            scene, walk, self.photons, seed, self.final_gather,
            (self.radii["caustic"], self.radii["global"]), self.lookup_size,
            median_footprint(scene, sensor, query),
        )  # fmt: skip

    def estimators(self, request, spp, learning):
        self.maps = self._traced(request.scene, request.sensor, request.seed)
        return functools.partial(self._estimator, request.scene, self.maps)

    def _estimator(
        self, scene: mi.Scene, maps: PhotonMaps, decisions: Decisions,
        observer: Observer | None = None,
    ) -> Walk:  # fmt: skip
        # Without a final gather, one more segment finds direct light
        last = ENDED if self.final_gather else GATHERS_ON
        if self.guided and maps.gathered is not None:
            decisions = replace(decisions, scattering=PhotonDirections(maps))
        photons = PhotonSubpaths(*maps.estimates(scene, self.max_depth), self.final_gather)
        program = GatheringPaths(photons, last)
        return replace(self.walk(decisions, observer), program=program)

    def aov_names(self) -> list[str]:
        if not self.photon_aovs:
            return super().aov_names()
        channels = "RGB" if len(mi.Spectrum()) > 1 else "Y"
        return super().aov_names() + [f"{name}.{c}" for name in _MAPS for c in channels]

    def sample_aovs(self, scene, sampler, ray) -> list[mi.Float]:
        values = super().sample_aovs(scene, sampler, ray)
        if self.photon_aovs:
            query, ray_alone = self.query(scene), mi.Ray3f(ray)
            pi = query.closest(scene, ray_alone, coherent=True, active=mi.Bool(True))
            si = query.interaction(pi, ray_alone)
            vertex = first_vertex(scene, si, ray)
            active = si.is_valid() & is_diffuse(vertex.bsdf)
            for estimate in self.maps.estimates(scene, self.max_depth):
                L = dr.zeros(mi.Spectrum, dr.width(si))
                if estimate is not None:
                    L = estimate.gather(scene, sampler, vertex, active)[0]
                values += list(L)
        return values
