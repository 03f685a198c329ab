"""Instant radiosity: virtual point lights, with bounded connections and exact compensation."""

from __future__ import annotations

import functools
from dataclasses import replace

import mitsuba as mi

from mitsuba_ext.bases.slots import read_slot
from mitsuba_ext.bases.walk_integrator import WalkIntegrator
from mitsuba_ext.estimators.light_paths.light_side import LightSide
from mitsuba_ext.estimators.light_paths.light_walk import LightWalk
from mitsuba_ext.estimators.light_paths.merging.merging import scene_diagonal
from mitsuba_ext.estimators.light_paths.subpath_choice.parameters import LearnedSubpaths
from mitsuba_ext.estimators.light_paths.virtual_lights.instant_radiosity import (
    InstantRadiosity,
    Tally,
)
from mitsuba_ext.estimators.light_paths.virtual_lights.virtual_light_bound import Bound
from mitsuba_ext.estimators.light_paths.virtual_lights.virtual_light_choice import (
    PowerChoice,
    UniformChoice,
)
from mitsuba_ext.estimators.light_paths.virtual_lights.virtual_light_parts import (
    LIGHTS,
    PARTS,
    AllDirect,
    PictureOfLights,
)
from mitsuba_ext.estimators.light_paths.virtual_lights.virtual_light_tree import ClusteredChoice
from mitsuba_ext.estimators.light_paths.virtual_lights.virtual_lights import MOST_PATHS, Sets
from mitsuba_ext.planning.planner import Estimators
from mitsuba_ext.rendering.camera import film_extent
from mitsuba_ext.rendering.request import Request
from mitsuba_ext.rendering.stages import ReportedSchedule
from mitsuba_ext.rendering.statistics import RenderStatistics
from mitsuba_ext.scene.bsdfs import refuse_clear_curves
from mitsuba_ext.scene.movers import refuse_to_share
from mitsuba_ext.startup import registry
from mitsuba_ext.transport.decisions import Decisions
from mitsuba_ext.transport.estimator import Estimator
from mitsuba_ext.transport.observer import Observer

#: How virtual lights are chosen; "learned" is a slot of the walk.
_CHOICES = {
    "uniform": UniformChoice, "power": PowerChoice, "clustered": ClusteredChoice, "learned": None,
}  # fmt: skip


@registry.plugin
class InstantRadiosityIntegrator(WalkIntegrator):
    r"""
    .. _integrator-instant_radiosity:

    Instant radiosity (:monosp:`instant_radiosity`)
    -----------------------------------------------

    The vertices of a few light paths become virtual point lights, which all pixels share. Camera
    paths are connected to them at the first surface that is not a mirror, where most of them end.
    Connections are bounded, and BSDF sampling finds the light that the bound cuts off. The image
    therefore converges to the image of :monosp:`path`.

    .. pluginparameters::

     * - light_paths
       - |int|
       - Number of light paths that form a set of virtual lights. (Default: 300)
     * - interleaving
       - |int|
       - Neighbouring pixels use different sets, in a pattern that repeats after this many pixels in
         both directions; with 1, all pixels share one set. (Default: 1)
     * - connections
       - |int|
       - How many virtual lights a vertex is connected to. (Default: 1)
     * - choice
       - |string|
       - How virtual lights are chosen: :monosp:`uniform`; :monosp:`power` (by the flux that they
         emit); :monosp:`clustered` (by flux, distance and cosines, with a light tree); or
         :monosp:`learned` (by flux, and by how much light, occlusion included, pilot samples found
         to arrive at a place from each region: for long renders). (Default: power)
     * - bound
       - |float|
       - The largest geometry term of a connection, in units of 1 / (diagonal of the scene)². Larger
         values are faster, but noisier in corners; with 0, the integrator is :monosp:`path`.
         (Default: 5)
     * - compensation
       - |bool|
       - Whether BSDF sampling finds the light that the bound cuts off. If not, corners are too
         dark, and the image is biased: for previews. (Default: true)
     * - light_aovs
       - |bool|
       - Whether to write the parts that add up to the image to the channels :monosp:`direct.R`,
         :monosp:`virtual.R`, :monosp:`compensation.R`, …, and a picture of the virtual lights to
         :monosp:`lights.R`, …: see below. (Default: false)
     * - pilot_spp, save_learned, load_learned, keep_learned
       - |int|, |string| or |bool|
       - As in :class:`composed_path`; accepted only if :monosp:`choice` is :monosp:`learned`.
         (Default: 16, none, none, false)
     * - next_event, shadow_test
       - |string| or decision
       - How lights are chosen for direct light; see :class:`composed_path`.
     * - (Common parameters)
       - |several|
       - The parameters of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout,
         aovs, checkpoint.

    **Use it when** diffuse surfaces light each other in rooms with hidden lamps, or for a preview
    of indirect light: within a second without compensation, or denoised. **Not when** surfaces are
    glossy, caustics matter (:class:`vcm`), or light is mostly direct: it is then :monosp:`path` at
    a higher price.

    **Direct light** is sampled as in :monosp:`path`, with its MIS weights; points on lamps are not
    virtual lights. Virtual lights lie where a BSDF has a part that is not a delta distribution;
    light paths pass via mirrors and through clear glass. A camera path is connected at vertices on
    such surfaces, after any chain of mirrors and glass.

    **The bound.** A connection has the weight min(1, b / K). A camera path that continues to a
    surface where a virtual light could be has the weight max(0, 1 − b / K) for everything that
    leaves this surface by reflection; if the weight is 0, the path ends. On diffuse surfaces, K is
    the geometry term G. Elsewhere, K = π p cos' / distance² · max(1, π p'), where p is the density
    of BSDF samples at the camera path's vertex (in place of its cosine), and p' is the density, at
    the virtual light, of the direction from which its light comes. Both densities are large in
    narrow lobes: connections via glossy surfaces hardly count, and the camera path continues there
    as at mirrors. No roughness threshold has to be chosen for this. Without compensation, camera
    paths still find this glossy part of the difference, but nothing else.

    **Sets.** A pass takes some samples of each pixel. The first samples of all pixels share one
    set, the second ones another, and so on; if there are several sets, the number of light paths in
    a set is at most a quarter of the number of samples that use it. With :monosp:`learned`, a
    sample chooses from all sets of the pass. If a vertex has several connections, they are spread
    evenly over the set, in its order or in the order of the tree. All choices give each virtual
    light a probability above 0, and its contribution is divided by this probability.

    **The contribution of virtual lights** is shown by :monosp:`light_aovs`. The channel
    :monosp:`virtual` contains the light from connections to them, :monosp:`compensation` the light
    that camera paths found with a weight below one, and :monosp:`direct` all light that camera
    paths found with full weight: visible lamps, direct light, and light via mirrors and glass. If
    :monosp:`compensation` is noisy, a larger bound helps; if :monosp:`virtual` is noisy, more
    connections help. In :monosp:`lights`, each virtual light that a :monosp:`perspective` or
    :monosp:`thinlens` sensor sees is a dot, as bright as the radiance that it sends to the camera;
    with many samples, the dots become the image of a light tracer.

    ``statistics.learned`` reports the number of virtual lights and the bound, in units of the
    scene.

    **The learned choice** is next event estimation++ over virtual lights. Because these differ in
    each pass, the integrator learns how much light reaches one region of surfaces from another, for
    each pair of regions. It then chooses a region by this value and the brightness of the virtual
    lights there, and one of those by its flux.

    Virtual lights on glossy surfaces show as dim, noisy reflections of lamps. Virtual spherical
    lights were tried, and are worse (docs/results/instant_radiosity.md). Spectral variants, moving
    shapes and lights, and participating media are refused, because camera paths of different
    wavelengths and times cannot share virtual lights. Curves whose BSDF transmits light, such as
    :monosp:`hair`, are refused, because light paths do not pass through them (use :class:`bdpt`).
    Lights of type :monosp:`directionalarea`, which :monosp:`path` does not find, contribute
    indirect light only. As with :class:`bdpt`, images differ from :monosp:`path` in scenes far from
    the origin. Gradients are not supported (use :class:`composed_prb`), and neither is nesting in
    :monosp:`moment` and :monosp:`aov`.

    Source: A. Keller, *Instant Radiosity*, SIGGRAPH 1997; T. Kollig, A. Keller, *Illumination in
    the Presence of Weak Singularities*, MCQMC 2004, section 3 (bound and compensation; K for glossy
    surfaces is ours); B. Walter et al., *Lightcuts*, ACM Transactions on Graphics 24(3), 2005 (the
    tree); J. Guo, M. Eisemann, E. Eisemann, *Next Event Estimation++: Visibility Mapping for
    Efficient Light Transport Simulation*, Computer Graphics Forum 39(7), 2020, section 4.2 (learned
    visibility between places; contributions are ours); D. Cline, PhD thesis, 2007, section 7.8,
    figure 7.15.

    .. tabs::
        .. code-tab:: xml

            <integrator type="instant_radiosity">
                <integer name="light_paths" value="500"/>
                <integer name="max_depth" value="8"/>
            </integrator>

        .. code-tab:: python

            'type': 'instant_radiosity',
            'light_paths': 500,
            'max_depth': 8
    """

    no_expressions = (
        'the bound divides the light of a path between virtual lights and longer paths; use "bdpt"'
    )
    has_light_paths = True

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.light_paths = self.parameter(
            props, "light_paths", 300, minimum=1, maximum=MOST_PATHS
        )
        self.interleaving = self.parameter(props, "interleaving", 1, minimum=1, maximum=64)
        self.connections = self.parameter(props, "connections", 1, minimum=1, maximum=65536)
        self.choice = self.parameter(props, "choice", "power", choices=tuple(_CHOICES))
        self.bound = self.parameter(props, "bound", 5.0, minimum=0.0)
        self.compensation = self.parameter(props, "compensation", True)
        self.light_aovs = self.parameter(props, "light_aovs", False)
        slots = {key: read_slot(self.name, props, key) for key in ("next_event", "shadow_test")}
        if self.choice == "learned":
            slots["subpath_selection"] = LearnedSubpaths()
        self.fill(props, **slots)

    @property
    def sample_cost(self) -> int:
        return max(2, super().sample_cost)

    def schedule(self, request, samples, learning):
        # What connections count, until the render reports it
        tally = Tally()
        estimators = self._counted_estimators(request, tally)
        planner = self.planner(request, samples, learning, estimators)
        return ReportedSchedule(planner, functools.partial(self._report, tally, request.scene))

    def _largest(self, scene: mi.Scene) -> float:
        return self.bound / scene_diagonal(scene) ** 2

    def _counted_estimators(self, request: Request, tally: Tally) -> Estimators:
        scene, film = request.scene, request.sensor.film()
        refuse_to_share(
            scene, self.name,
            "camera paths of other wavelengths and times cannot share virtual lights; use "
            '"bdpt" or "path"',
        )  # fmt: skip
        if not scene.emitters() or self.max_depth < 3:
            return self._walk_alone if self.light_aovs else self.walk
        refuse_clear_curves(scene, f'"{self.name}"')
        side = LightSide.of(self.name, scene, request.sensor, has_image=self.light_aovs)
        width, height = film_extent(film)
        sets = Sets(width * height, width, self.light_paths, self.interleaving)
        picture = None
        if self.light_aovs:
            picture = PictureOfLights(side.sensor, width * height, width, film.crop_offset())
        largest = self._largest(scene)
        return functools.partial(self._estimator, side, sets, picture, largest, tally)

    def _walk_alone(self, decisions: Decisions, observer: Observer | None = None) -> Estimator:
        return AllDirect(self.walk(decisions, observer))

    def _estimator(
        self,
        side: LightSide,
        sets: Sets,
        picture: PictureOfLights | None,
        largest: float,
        tally: Tally,
        decisions: Decisions,
        observer: Observer | None = None,
    ) -> Estimator:
        selection, next_event = decisions.subpath_selection, side.next_event(decisions.next_event)
        walk = self.walk(replace(decisions, next_event=next_event), observer)
        # Two more segments lead from the last virtual light to the sensor
        light_walk = LightWalk(
            side.emission, self.max_depth - 1, self.rr_depth, query=walk.query
        )
        chosen = {} if selection is None else {"selection": selection}
        return InstantRadiosity(
            walk, light_walk, sets, Bound(largest, self.compensation), self.connections,
            _CHOICES[self.choice] or UniformChoice, tally=tally, picture=picture, **chosen,
        )  # fmt: skip

    def aov_names(self) -> list[str]:
        channels = "RGB" if len(mi.Spectrum()) > 1 else "Y"
        own = [f"{layer}.{c}" for layer in (*PARTS, LIGHTS) for c in channels]
        return (own if self.light_aovs else []) + super().aov_names()

    def _report(self, tally: Tally, scene: mi.Scene, statistics: RenderStatistics) -> None:
        if tally.sets:
            lights = tally.lights / tally.sets
            statistics.add_learned(
                f"{lights:.0f} virtual lights in a set, {tally.sets} sets, connections bounded by "
                f"{self._largest(scene):.3g} / length²"
            )
