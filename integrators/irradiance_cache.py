"""Irradiance caching with gradients."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import replace

import mitsuba as mi

from mitsuba_ext.bases.learned_state import check_target, file_of
from mitsuba_ext.bases.slots import read_slot
from mitsuba_ext.bases.staged_integrator import NO_LIMIT
from mitsuba_ext.bases.walk_integrator import WalkIntegrator
from mitsuba_ext.estimators.caches.cached_light import CachedLight
from mitsuba_ext.estimators.caches.gathering import Gatherer
from mitsuba_ext.estimators.caches.hemisphere import Strata
from mitsuba_ext.estimators.caches.irradiance_rounds import CacheParameters, CacheRounds, deadline
from mitsuba_ext.estimators.caches.record_grid import RecordGrid
from mitsuba_ext.estimators.caches.records import Records
from mitsuba_ext.planning.learned_file import LearnedFile
from mitsuba_ext.rendering.camera import film_extent
from mitsuba_ext.rendering.request import Request
from mitsuba_ext.rendering.stages import ReportedSchedule
from mitsuba_ext.rendering.statistics import RenderStatistics
from mitsuba_ext.scene.movers import refuse_to_share
from mitsuba_ext.startup import registry
from mitsuba_ext.transport.connection import can_be_hit
from mitsuba_ext.transport.decisions import Decisions
from mitsuba_ext.transport.observer import Observer
from mitsuba_ext.transport.walk import Walk

#: The parameters on which records depend.
_OF_RECORDS = (
    "max_depth", "rr_depth", "accuracy", "min_spacing", "max_spacing", "gather_samples",
    "max_share",
)  # fmt: skip


@registry.plugin
class IrradianceCache(WalkIntegrator):
    r"""
    .. _integrator-irradiance_cache:

    Irradiance cache (:monosp:`irradiance_cache`)
    ---------------------------------------------

    Computes the irradiance of indirect light and its gradients at a few places on diffuse surfaces,
    from many paths each, and interpolates between these places. Direct light, and everything that
    is not diffuse, is sampled as in :monosp:`path`.

    .. pluginparameters::

     * - accuracy
       - |float|
       - *a* of Eq. 10.9: the relative change of irradiance, estimated from distances and normals,
         that is allowed between a record and a place that uses it. Smaller values give denser
         records. (Default: 0.4)
     * - min_spacing
       - |float|
       - The smallest radius in which a record is valid, in pixel widths at its place. (Default: 2)
     * - max_spacing
       - |float|
       - The largest radius in which a record is valid, in the same units. (Default: 60)
     * - gather_samples
       - |int|
       - Approximate number of paths from each record. (Default: 512)
     * - effort
       - |float|
       - Maximum number of paths from all records, divided by the number of samples of the image. A
         render with few samples makes few records, and continues as :monosp:`path` elsewhere.
         (Default: 0.5)
     * - max_share
       - |float|
       - The largest share of a record's irradiance that one path may contribute; any excess is cut
         off. Otherwise rare bright paths (caustics) leave spots as wide as the radius in which
         records are valid. 1 cuts nothing off. (Default: 0.1)
     * - cache_file
       - |string|
       - Name of a file that keeps the records. A render reads it if it exists, adds the records
         that its view needs, and writes it. Other cameras can use it in the same scene with the
         same parameters, for example in the frames of an animation. (Default: none)
     * - next_event, shadow_test
       - |string| or decision
       - How lights are chosen; see :class:`composed_path`. The paths from records use them too. If
         they learn, pilot samples are taken as in :monosp:`path`.
     * - (Common parameters)
       - |several|
       - The parameters of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout,
         aovs, checkpoint.

    **Use it when** surfaces are mostly diffuse, indirect light causes the noise, and you want a
    smooth image soon; or for an animation of the camera, with :monosp:`cache_file`. **Not when** a
    denoiser is an option (denoised :monosp:`path` is closer to the truth in the same time), the
    image must be right, surfaces are glossy, details are as small as pixels everywhere (plants,
    hair: each detail needs records), or direct light causes the noise.

    **How it works.** A *record* is a place with its irradiance, two gradients, and a radius. Camera
    rays through a coarse grid of pixels, then finer ones, find places that no record covers. Some
    of these places get a record, such that no two new records are close to each other. A record is
    computed from paths through the strata of the hemisphere (Eqs. 10.6 and 10.7). These are paths
    of :monosp:`path` in full length, and never look up the cache, so errors do not grow from bounce
    to bounce. Light that the first segment hits is direct light, and not counted. The radius is the
    harmonic mean of the distances to the visible surfaces, times the accuracy, or less if the
    gradient is steep. It is clamped by the radii of neighbours, and a record that mispredicts a
    neighbour does not extend to it. Then the samples of the image are taken: where a camera path
    samples a diffuse lobe, the indirect light is interpolated from the surrounding records. At
    places that no record covers (with enough samples, a thousandth of the pixels, and surfaces seen
    in glossy reflections), paths continue as in :monosp:`path`.

    The image is biased with any number of samples: interpolation is inexact, and each record has
    noise that all pixels around it share. The error falls with :monosp:`accuracy` and
    :monosp:`min_spacing`, and with more :monosp:`gather_samples`. Weights are 1 − ε/a instead of
    1/ε as in Eq. 10.9, which would show the noise of records; and records overlap by 1.3 times
    their radius.

    Caustics are part of the irradiance, blurred and with the noise of :monosp:`path`; for caustics,
    use :class:`vcm`. Normal and bump maps do not show in indirect light of diffuse lobes. Through
    mirrors and glass, paths may be longer than :monosp:`max_depth` by the segments before the
    diffuse surface. A :monosp:`timeout` leaves half of the time to the records.

    Spectral variants, moving shapes and participating media are refused, because all wavelengths
    and times share the records. Gradients are not supported (use :class:`composed_prb`), and
    neither is nesting in :monosp:`moment` and :monosp:`aov`.

    Source: G. J. Ward, F. M. Rubinstein, R. D. Clear, *A Ray Tracing Solution for Diffuse
    Interreflection*, SIGGRAPH 1988; G. J. Ward, P. S. Heckbert, *Irradiance Gradients*,
    Eurographics Workshop on Rendering, 1992; J. Křivánek, K. Bouatouch, S. Pattanaik, J. Žára,
    *Making Radiance and Irradiance Caching Practical: Adaptive Caching and Neighbor Clamping*, EGSR
    2006; H. W. Jensen et al., *State of the Art in Monte Carlo Global Illumination*, SIGGRAPH
    course, 2004, section 10.4, Eqs. 10.6 to 10.9; D. Cline, PhD thesis, 2007, section 7.5.

    .. tabs::
        .. code-tab:: xml

            <integrator type="irradiance_cache">
                <float name="accuracy" value="0.2"/>
                <string name="cache_file" value="flight.npz"/>
            </integrator>

        .. code-tab:: python

            'type': 'irradiance_cache',
            'accuracy': 0.2,
            'cache_file': 'flight.npz'
    """

    no_expressions = (
        'its records hold light of all kinds together; use "composed_path" or "auto"'
    )
    sees_media = False

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.accuracy = self.parameter(props, "accuracy", 0.4, minimum=0.01, maximum=1.0)
        self.min_spacing = self.parameter(props, "min_spacing", 2.0, minimum=0.1, maximum=1e6)
        self.max_spacing = self.parameter(props, "max_spacing", 60.0, minimum=0.1, maximum=1e6)
        self.gather_samples = self.parameter(
            props, "gather_samples", 512, minimum=4, maximum=1 << 16
        )
        self.effort = self.parameter(props, "effort", 0.5, minimum=0.0, maximum=1e6)
        self.max_share = self.parameter(props, "max_share", 0.1, minimum=0.001, maximum=1.0)
        self.cache_file = self.parameter(props, "cache_file", "", none="none")
        #: The records of the last render, and what each round of it did.
        self.records, self.rounds = Records.none(3), []
        if self.min_spacing > self.max_spacing:
            raise ValueError(
                f'"{self.name}": "min_spacing" is {self.min_spacing:g}, and "max_spacing" '
                f"{self.max_spacing:g}: it must not be smaller"
            )
        slots = {key: read_slot(self.name, props, key) for key in ("next_event", "shadow_test")}
        self.fill(props, **slots)

    # ---- The render ----

    def query(self, scene):
        refuse_to_share(
            scene, self.name,
            'records are shared by all wavelengths and times; use "auto" or "photon_map"',
        )  # fmt: skip
        return super().query(scene)

    def schedule(self, request, samples, learning):
        self.records, self.rounds = Records.none(len(mi.Spectrum())), []
        return ReportedSchedule(super().schedule(request, samples, learning), self._report)

    def estimators(self, request, spp, learning):
        has_time = deadline(0.5 * request.timeout, time.perf_counter())
        return functools.partial(self._estimator, request, spp, has_time)

    def _estimator(
        self, request: Request, spp: int, has_time: Callable[[], bool], decisions: Decisions,
        observer: Observer | None = None,
    ) -> Walk:  # fmt: skip
        scene, walk = request.scene, self.walk(decisions, observer)
        # Pilots teach decisions that the paths of records then use
        if observer is not None or self.max_depth < 3 or not scene.emitters():
            return walk
        grid = self._cached(request, spp, has_time, walk)
        return replace(walk, program=CachedLight(grid, self.max_depth, can_be_hit(scene)))

    def _cached(
        self, request: Request, spp: int, has_time: Callable[[], bool], walk: Walk
    ) -> RecordGrid:
        """Makes the records that the view needs, for a render of ``spp`` samples per pixel."""
        scene, sensor, seed = request.scene, request.sensor, request.seed
        parameters = CacheParameters(self.accuracy, self.min_spacing, self.max_spacing)
        depth = self.max_depth if self.max_depth == NO_LIMIT else self.max_depth - 1
        inner = replace(
            walk, max_depth=depth, rr_depth=max(1, self.rr_depth - 1), hide_emitters=False
        )
        strata = Strata.about(self.gather_samples)
        gatherer = Gatherer(
            scene, inner, strata, parameters.bounds, self.min_spacing, self.max_share, seed
        )
        file = self._file(scene)
        known = self._known(file)
        width, height = film_extent(sensor.film())
        most = int(self.effort * (spp * width * height) / strata.count)
        rounds = CacheRounds(scene, sensor, walk, gatherer, parameters, seed, known, most)
        rounds.run(has_time)
        self.records, self.rounds = rounds.records, rounds.rounds
        if file is not None and len(self.records) > len(known):
            file.save({"records": self.records.arrays()})
        return rounds.final_grid()

    def _file(self, scene: mi.Scene) -> LearnedFile | None:
        if not self.cache_file:
            return None
        check_target(self.name, "cache_file", self.cache_file)
        shown = {**self.common_parameters(), **self.parameters()}
        made_by = ", ".join(f"{key} = {shown[key]}" for key in _OF_RECORDS)
        made_by += f" ({mi.variant()})"
        return file_of(self.name, "cache_file", self.cache_file, scene, made_by)

    def _known(self, file: LearnedFile | None) -> Records:
        """The records of earlier renders."""
        stored, channels = file.load() if file else None, len(mi.Spectrum())
        if stored is None:
            return Records.none(channels)
        return Records.of_arrays(stored.part("records/"), channels)

    def _report(self, statistics: RenderStatistics) -> None:
        if self.rounds:
            made, last = sum(r.made for r in self.rounds), self.rounds[-1]
            statistics.add_learned(
                f"{len(self.records)} records of irradiance ({made} new), "
                f"{last.uncovered / max(1, last.asked):.2%} of the places uncovered before the "
                f"last round; the image is biased"
            )

    def sample(self, scene, sampler, ray, medium=None, active=True):
        raise NotImplementedError(
            f'"{self.name}": records are made before the render of a film: it cannot be nested in '
            f'an integrator that asks for single samples, such as "moment" or "aov"; "variance" '
            f'can hold it, and it has a parameter "aovs" of its own'
        )
