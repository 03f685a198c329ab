"""An integrator that decides by itself what pays, light paths included."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import mitsuba as mi

from mitsuba_ext.bases.bidirectional_integrator import LightPathIntegrator
from mitsuba_ext.bases.slots import auto_techniques
from mitsuba_ext.estimators.light_paths.choice.candidates import Candidate
from mitsuba_ext.estimators.light_paths.choice.light_paths import (
    AutoLightPaths,
    LightPathTrial,
)
from mitsuba_ext.estimators.light_paths.emission import LightEmission
from mitsuba_ext.estimators.light_paths.light_media import outside_of
from mitsuba_ext.estimators.light_paths.merging.merging_parameters import MergingParameters
from mitsuba_ext.estimators.light_paths.path_memory import bytes_of_both_paths
from mitsuba_ext.estimators.light_paths.photons.photons import photon_mapper
from mitsuba_ext.planning.costs import LEARNING_KERNELS, TRIAL_KERNELS
from mitsuba_ext.rendering.camera import film_extent
from mitsuba_ext.rendering.device import SampleBytes, device_of
from mitsuba_ext.rendering.request import Request
from mitsuba_ext.scene.bsdfs import has_clear_curves
from mitsuba_ext.scene.media import may_have_media
from mitsuba_ext.scene.movers import movers
from mitsuba_ext.startup import registry

#: Light paths are not tried in films with more pixels than fit into this number of times the memory
#: of a pass, on a CPU: a third of its memory. (A pass has at least one sample of each pixel.)
_EXCESS = 5


@registry.plugin
class Auto(LightPathIntegrator):
    r"""
    .. _integrator-auto:

    Self-configuring integrator (:monosp:`auto`)
    --------------------------------------------

    Begins as :monosp:`path`, and measures which techniques are worth their time in this scene:
    guided directions or focal points, learned lights, and maps of times, lens points, wavelengths
    and distances (:class:`auto_path`); light paths, their number, the number of connections to
    them, and merging with them (:class:`vcm`; in participating media, also :class:`sppm`).

    .. pluginparameters::

     * - pilot_spp
       - |int|
       - Number of pilot samples per pixel, from which the integrator learns; at most an eighth of
         all samples up to 262144 pilot samples, a sixteenth beyond, and a quarter in short renders.
         They count towards the image. With 0, it learns nothing and renders as :monosp:`path` does,
         with a light tree. (Default: 32; 0 in renders of fewer than 262144 samples)
     * - save_learned, load_learned
       - |string|
       - Names of files. The render saves all that it has learned to :monosp:`save_learned`. With
         :monosp:`load_learned`, it takes no pilot samples, but uses what a render of the same
         scene, with the same parameters and film size, has saved, even from another camera.
         (Default: none)
     * - keep_learned
       - |bool|
       - Whether to keep what is learned for later renders of this process (frames, notebooks). A
         later render of the same scene, with the same parameters and film size, then takes no pilot
         samples, even from another camera. It learns again if it would take more pilot samples than
         the earlier render. An image then depends on the renders before it. (Default: false)
     * - (Common parameters)
       - |several|
       - The parameters of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout,
         aovs, checkpoint.

    **Use it when** you do not know which technique a scene needs. **Not when** an image has fewer
    than 16 samples per pixel and one light: there is too little to learn from.

    The first two pilots are the same as in :class:`auto_path`. A short trial follows, with one
    light path for each camera path, all techniques, and the lights learned so far. Its samples
    predict the variance of each choice: no light paths, or 1/16, 1/4, 1 or 4 of them per camera
    path; 0, 1, 2 or 4 connections from each vertex of a camera path to their vertices; with or
    without merging. Counts of rays predict the time of each choice. The integrator uses the best of
    these choices if it is better than guided directions or focal points, and maps. Focal points and
    maps are then dropped. Guided directions that paid before are learned again, from samples with
    light paths, unless vertices are merged; together with light paths, a guide is expected to keep
    the square root of its efficiency. The trial has 16384 samples, spread over the film, which are
    not part of the image (8192 in renders of less than a million samples, 4096 of less than half a
    million; in participating media, where such a sample takes longer, four million and two
    million). A trial of 4096 samples precedes it, except in media, and replaces it where light
    paths are worse beyond doubt. If light paths reduce the variance to less than 0.4 of its value,
    the samples before the trial are left out of the image.

    With fewer than 262144 samples (33554432 on a GPU, which takes more samples in the same time),
    the integrator skips learning and renders as :monosp:`path` does, except that it chooses among
    several lights by a light tree (:monosp:`next_event=tree` of :class:`composed_path`), unless the
    scene gives a :monosp:`pilot_spp` of 1 or more, or the integrator saves or keeps what it learns.
    Learning, and compiling the kernels that it needs, would take longer than rendering all samples.
    :monosp:`statistics.learned` then says so. The shorter a render is, the more light paths must
    gain: 1.1 times the efficiency of everything else that was learned, and twice that efficiency in
    renders of half a million samples. With a :monosp:`timeout`, light paths are tried only if there
    is time to compile their kernels.

    The best choice has the smallest product of time and expected squared error in a render of this
    length. For choices without light paths, the squared error includes the square of the light that
    only light paths find. In a short render, the noise of light paths can be larger than this
    error. **A short render may therefore miss light that** :monosp:`path` **misses** (for example
    the caustic of a point light); a long render finds it. :monosp:`statistics.learned` then says
    how much of the light is missing, and :monosp:`statistics.effects["light_paths"]` contains it as
    :monosp:`missed`.

    The differences between the passes of the later pilots show the actual variance with light
    paths. Before the last stage, the integrator returns to its earlier choice if that variance,
    times the predicted time, exceeds the value without light paths by more than the error of the
    measurement. (Everything else that is learned is tested in each pilot.)

    In scenes with participating media, all vertices are merged where any are, as with
    :monosp:`merging=all` of :class:`vcm`. Merging also shows how rarely camera paths find light
    that no connection reaches: light that enters clear glass, scatters once in a medium there, and
    leaves the glass. Photons alone are one candidate more, which are rendered as in :class:`sppm`:
    they gather light at several points of a ray. The trial has samples of them in renders of two
    million samples or more. If photons are chosen, nothing else is learned, so that no pilots are
    left to test this choice.

    Light paths are not tried in films for whose pixels a third of the memory does not suffice (two
    million pixels with 16 GiB), if a light cannot emit them, or if light from infinity shines
    through a medium without a boundary: the integrator then works as :class:`auto_path`. In
    spectral variants and with moving shapes, nothing is merged, and there are no photons.

    If vertices are merged, or photons are used, the image is slightly blurred, less with each
    sample (:class:`vcm`, :class:`sppm`).

    :monosp:`integrator.statistics.learned` says what was chosen, and what it was expected to gain.
    Gradients are not supported (use :class:`composed_prb`); neither are scalar and polarized
    variants. Nested in :monosp:`moment`, it takes no pilot samples.

    Sources: see :class:`auto_path`, :class:`vcm` and :class:`sppm`; P. Grittmann, I. Georgiev, P.
    Slusallek, *Efficiency-Aware Multiple Importance Sampling for Bidirectional Rendering
    Algorithms*, ACM Transactions on Graphics 41(4), 2022.

    .. tabs::
        .. code-tab:: xml

            <integrator type="auto">
                <integer name="max_depth" value="8"/>
            </integrator>

        .. code-tab:: python

            'type': 'auto',
            'max_depth': 8
    """

    techniques_by_default = Candidate(0.0)
    learns_if_long = True

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.merging = MergingParameters(0.0, 0.75)
        self.fill(props, **auto_techniques(self.name))

    @property
    def needs_equal_samples(self) -> str:
        return 'its light paths may find light for all pixels: use "auto_path"'

    @property
    def sample_cost(self) -> int:
        return 1

    @property
    def sample_bytes(self) -> SampleBytes:
        # Stages with light paths have limits of their own
        return SampleBytes()

    def plan_learning(self, request, spp, kernels=math.inf):
        scene, film = request.scene, request.sensor.film()
        pixel_count = math.prod(film_extent(film))
        plan = super().plan_learning(request, spp, kernels)
        tries = bool(plan.pilots) and LightPathTrial.is_possible(pixel_count, spp)
        tries &= kernels >= LEARNING_KERNELS + TRIAL_KERNELS
        fits = pixel_count <= self._most_pixels
        if not (tries or plan.restore) or not fits or not self._can_try(request):
            return plan
        has_photons = _has_photons(scene)
        trial = functools.partial(LightPathTrial.in_own_stage, film, has_photons)
        return replace(plan, tries=tries, trial=trial)

    def estimators(self, request, spp, learning):
        if learning.trial is None:
            return self.walk
        estimators = super().estimators(request, spp, learning)
        if not _has_photons(request.scene):
            return estimators
        return replace(estimators, photons=functools.partial(photon_mapper, self, request))

    def merges_all(self, scene):
        return may_have_media(scene)

    def merging_radius(self, request, side, *sums):
        if not _can_merge(request.scene):
            return None
        return super().merging_radius(request, side, *sums)

    @property
    def _most_pixels(self) -> int:
        """The number of pixels up to which light paths are tried."""
        device = device_of(mi.Float)
        fits = device.lanes(bytes_of_both_paths(1.0, self.max_depth))
        return fits if device.is_gpu else _EXCESS * fits

    def _can_try(self, request: Request) -> bool:
        """Whether light paths can be tried."""
        scene = request.scene
        if self.max_depth < 2 or not AutoLightPaths().can_learn(scene, 1):
            return False
        try:
            LightEmission(scene)
            outside_of(self.name, self.query(scene), scene, request.sensor)
        except NotImplementedError:
            return False
        return True


def _can_merge(scene: mi.Scene) -> bool:
    """Only paths of equal wavelengths and times merge: all pixels would have to share these, even
    if nothing is merged in the end."""
    return not (mi.is_spectral or movers(scene))


def _has_photons(scene: mi.Scene) -> bool:
    """Whether photons are a candidate: in scenes with media, where vertices are not merged beside
    other techniques. No light may pass through curves, because photons would have to find it."""
    return may_have_media(scene) and _can_merge(scene) and not has_clear_curves(scene)
