"""Gradients of the path tracer whose decisions are chosen in the scene."""

from __future__ import annotations

import importlib
from dataclasses import replace

import drjit as dr
import mitsuba as mi
from mitsuba.ad.integrators import common

from mitsuba_ext.bases.remembering_path import RememberingPath
from mitsuba_ext.bases.sensitive_path import SensitivePath
from mitsuba_ext.rendering.camera import PassLanes, film_extent, find_sensor
from mitsuba_ext.rendering.gradient_pass import GradientSamples, ReplayedWalk, propagate
from mitsuba_ext.rendering.loss_samples import loss_samples
from mitsuba_ext.rendering.pixel_sensitivity import PixelSensitivity
from mitsuba_ext.rendering.turns import in_turn
from mitsuba_ext.scene.gradients import (
    Optimized,
    RoughBSDFs,
    doubtful_gradients,
    has_gaps,
    has_roughness,
    masked_mirrors,
    optimized_parameters,
    optimizes_media,
    optimizes_mirrors,
    refuse_geometry,
    without_gradients,
)
from mitsuba_ext.scene.mark import SceneMark
from mitsuba_ext.startup import registry
from mitsuba_ext.transport.estimator import CameraRays
from mitsuba_ext.transport.mirrored_directions import PairedNumbers
from mitsuba_ext.transport.sensitivity import Sensitivity

# Mitsuba executes this module again for each variant, but perhaps not yet for this one
common = importlib.reload(common)

#: The most views of which it is remembered where derivatives come from, and the fewest samples of a
#: pixel that tell it.
_MOST_VIEWS, _LEAST_SPP = 64, 8

#: From this number and the seed of a pass, the seed of its measurement is derived.
_OF_VIEWS = 0x3C6EF372


@registry.plugin
class ComposedPRB(common.RBIntegrator):
    r"""
    .. _integrator-composed_prb:

    Gradients of the composed path tracer (:monosp:`composed_prb`)
    --------------------------------------------------------------

    Path replay backpropagation, as in Mitsuba's :monosp:`prb` and :monosp:`prbvolpath`, along the
    paths of :class:`composed_path`. Lights and directions can be learned, which makes gradients
    less noisy in scenes with many or hidden lights. For use with :monosp:`mi.render(scene, params,
    integrator=…)`.

    .. pluginparameters::

     * - directions
       - |string| or |decision|
       - As in :class:`composed_path`, except :monosp:`swarm`. (Default: uniform)
     * - next_event
       - |string| or |decision|
       - As in :class:`composed_path`, except :monosp:`resampled`, :monosp:`two_stage` and
         :monosp:`triple_product`. (Default: uniform)
     * - roulette
       - |string|
       - As in :class:`composed_path`. (Default: automatic)
     * - flights
       - |string|
       - As in :class:`composed_path`. (Default: automatic)
     * - connections
       - |string|, |int| or |decision|
       - As in :class:`composed_path`. (Default: one)
     * - mis
       - |string| or |decision|
       - As in :class:`composed_path`. (Default: power)
     * - shadow_test
       - |string| or |decision|
       - As in :class:`composed_path`. (Default: always)
     * - pilot_spp
       - |int|
       - As in :class:`composed_path`, but at most a fifth of the samples of the renders that use
         what is learned. (Default: 32 with guided directions, otherwise 16)
     * - save_learned, load_learned
       - |string|
       - As in :class:`composed_path`. (Default: none)
     * - learn_every
       - |int|
       - Number of renders of a scene after which the next one learns again, because materials and
         lights may have changed; 0 to learn only once. The number doubles each time, because what
         is learned stays good while parameters change little. The parameter is accepted only if a
         decision learns. (Default: 128)
     * - gradient_samples
       - |string|
       - Samples of the passes for gradients: :monosp:`even`, the same number in each pixel, or
         :monosp:`loss`, more in pixels where the derivative of the loss is large: the loss
         depends on them, and they depend on what is optimized. The latter is measured in the passes
         1, 2, 4, 8 and so on, by at least eight samples per pixel. Pixels that a mask removes from
         the loss get none. (Default: even)
     * - max_depth
       - |int|
       - Longest path in the image, -1 for no limit. (Default: -1)
     * - rr_depth
       - |int|
       - Path depth at which Russian roulette on the throughput begins, counted as in :monosp:`prb`:
         one vertex later than in :class:`composed_path`. (Default: 5)
     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: false)
     * - timeout
       - |float|
       - Seconds after which a render of the image (not of gradients) ends, learning included.
         (Default: -1, none)

    **Use it when** you optimize materials, textures, lights, environment maps or participating
    media: their albedo, their extinction (:monosp:`sigma_t`; Mitsuba's :monosp:`scale` has no
    derivatives), and parameters of phase functions. **Not when** you optimize the position or shape
    of objects, or the camera (use :monosp:`prb` or :monosp:`prb_projective`): these are refused,
    and so are moving shapes and dispersion. Gradients of exactly black colours lack the light that
    scattered rays would have found. After the first pass for gradients, a warning names parameters
    that have received none.

    Unlike in :monosp:`prb`, mirrors and smooth glass have gradients, and so has the opacity of
    masks, except for light that reaches a vertex in a medium through them. (:monosp:`prb` counts
    light of the mirror of a :monosp:`plastic` as light of its diffuse lobe, so that gradients of
    :monosp:`diffuse_reflectance` are biased.)

    The image is the same as with :class:`composed_path` if its :monosp:`rr_depth` is one more.
    Derivatives come from tracing the same
    walk a second time, with the same random numbers: at each vertex, the walk reports the radiance
    that the path has gathered so far, so the rest of its radiance is known. All densities, MIS
    weights and learned maps are treated as constants. With all defaults, and except with respect to
    roughness and of BSDFs such as :monosp:`plastic`, gradients are the same as with :monosp:`prb`,
    from the same random numbers.

    If the roughness of a conductor, a dielectric or a metallic :monosp:`principled` is optimized,
    samples form pairs where a camera ray meets it, if it is not very rough and not seen at a
    grazing angle. The two samples of a pair see the opposite parts of the derivative of its lobe,
    so that they cancel where light is uniform. Use an even number of samples per pixel.
    Gradients of :monosp:`roughplastic`, of BSDFs without :monosp:`sample_visible`, and within
    instances have no pairs.

    In media, the camera may be in fog, and extinctions may be coloured. Gradients are unbiased
    where a medium scatters nothing, too: where a grid is empty, and where an albedo or (unless the
    medium has no end) an extinction is 0. Some paths scatter there for derivatives only, which find
    the light that a little more would scatter. (:monosp:`prbvolpath` finds only the light that it
    would absorb: in empty regions, its gradient may have the wrong sign.) Media within instances,
    which are not accessible, have no such paths.

    Before the first render of a scene, pilot samples are taken, which are not part of the image.
    All renders, and the passes for gradients, use what is learned from them. :monosp:`forget()`
    makes the next render learn again. If some of several lights are optimized, the passes for
    gradients learn which light is best for their derivatives.

    Source: D. Vicini, S. Speierer, W. Jakob, *Path Replay Backpropagation: Differentiating Light
    Paths using Constant Memory and Linear Time*, ACM Transactions on Graphics 40(4), 2021; for
    empty regions of grids: M. Nimier-David, T. Müller, A. Keller, W. Jakob, *Unbiased Inverse
    Volume Rendering with Differential Trackers*, ACM Transactions on Graphics 41(4), 2022; for
    roughness: Y. Belhe, B. Xu, S. P. Bangaru, R. Ramamoorthi, T.-M. Li, *Importance Sampling BRDF
    Derivatives*, ACM Transactions on Graphics 43(3), 2024, and C. Zhang, Z. Dong, M. Doggett, S.
    Zhao, *Antithetic Sampling for Monte Carlo Differentiable Rendering*, ACM Transactions on
    Graphics 40(4), 2021.

    .. tabs::
        .. code-tab:: xml

            <integrator type="composed_prb">
                <string name="directions" value="guided"/>
                <string name="next_event" value="contribution"/>
            </integrator>

        .. code-tab:: python

            'type': 'composed_prb',
            'directions': 'guided',
            'next_event': 'contribution'
    """

    #: For remarks about scenes, as in :class:`WalkIntegrator`.
    sees_media = True

    # Bound here: a variant that is selected later replaces these names in the module
    _paths = RememberingPath, SensitivePath

    def __init__(self, props: mi.Properties) -> None:
        self.path, self._sensitive = (path(props) for path in self._paths)
        samples = self.path.parameter(
            props, "gradient_samples", "even", choices=("even", "loss")
        )
        self._follows_loss = samples == "loss"
        self._for_gradients = self.path
        super().__init__(props)
        self.name, self.max_depth = self.path.name, self.path.max_depth
        self.rr_depth = self.path.rr_depth
        self._pixel_count, self._sensor = 1, None
        self._flights, self._fills_gaps = True, False
        self._mirrors, self._masks = False, None
        self._told: set[frozenset[str]] = set()
        self._views: dict[tuple, PixelSensitivity] = {}
        self._rough: RoughBSDFs | None = None

    @property
    def statistics(self):
        """See :class:`StagedIntegrator`."""
        return self.path.statistics

    @property
    def gradient_statistics(self):
        """Statistics of the samples from which the passes for gradients have learned."""
        return self._sensitive.statistics

    def to_string(self) -> str:
        return str(self.path)

    @property
    def learn_every(self) -> int:
        """The parameter; 0 if no decision learns."""
        return self.path.learn_every

    @property
    def learned(self) -> object:
        """See :class:`RememberingPath`."""
        return self.path.learned

    def learns_within(self, renders: int) -> bool:
        """See :class:`RememberingPath`."""
        return self.path.learns_within(renders)

    def forget(self) -> None:
        """Learns again in the next render."""
        self.path.forget()
        self._sensitive.forget()
        self._views.clear()

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        sensor = find_sensor(scene, sensor)
        with in_turn(self, sensor), dr.suspend_grad():
            return self.path.render(scene, sensor, seed, spp, develop, evaluate)

    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        sensor = find_sensor(scene, sensor)
        with in_turn(self, sensor):
            self._learn_for(scene, optimized_parameters(params), sensor, seed, spp)
            return super().render_forward(scene, params, sensor, seed, spp)

    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        sensor = find_sensor(scene, sensor)
        if self._follows_loss:
            self.path.refuse_recording('"gradient_samples": "loss"')
        with in_turn(self, sensor):
            optimized = optimized_parameters(params)
            is_new = self._learn_for(scene, optimized, sensor, seed, spp)
            view = self._view(scene, optimized, sensor, seed, spp) if self._follows_loss else None
            with dr.suspend_grad():
                seed = _opaque(seed)
                sampler, spp = super().prepare(sensor, seed, spp)
                if view is not None:
                    samples = loss_samples(sensor, spp, grad_in, int(seed[0]), view.mean)
                else:
                    samples = GradientSamples(PassLanes.of(sensor.film(), spp, 0, None), spp)
                propagate(
                    self._replayed(scene, sensor), scene, sensor, sampler, seed, samples, grad_in,
                    [*optimized.values()],
                )  # fmt: skip
            if is_new:
                self._tell_of_zeros(params, grad_in)

    def _learn_for(self, scene, optimized, sensor, seed, spp) -> bool:
        """Prepares a pass for gradients. Returns whether it is the first one with respect to these
        parameters."""
        keys = frozenset(optimized)
        refuse_geometry(self.name, keys)
        is_new = self._tell_of_doubts(scene, keys)
        learned = self._sensitive.prepare(scene, keys, sensor, seed, spp)
        self._for_gradients = self._sensitive if learned else self.path
        self._flights = optimizes_media(scene)
        self._fills_gaps = has_gaps(scene)
        self._mirrors = optimizes_mirrors(scene)
        self._masks = masked_mirrors(scene) if self._mirrors else None
        self._rough = RoughBSDFs.of(scene) if has_roughness(keys) else None
        return is_new

    def _view(self, scene, optimized, sensor, seed, spp) -> PixelSensitivity:
        """Where in the image of a sensor derivatives come from."""
        film = sensor.film()
        window = film_extent(film), tuple(film.crop_offset())
        key = SceneMark(scene).index, sensor.ptr, *window, *sorted(optimized)
        view = self._views.pop(key, None) or PixelSensitivity()
        if view.is_due():
            walk = self._for_gradients.remembered(scene, sensor)
            walk = replace(walk, program=Sensitivity(Optimized(scene)))
            with dr.suspend_grad():
                # Not the random numbers of the pass for gradients
                seed = mi.sample_tea_32(mi.UInt32(seed), _OF_VIEWS)[0]
                spp = max(spp or sensor.sampler().sample_count(), _LEAST_SPP)
                sampler, spp = super().prepare(sensor, seed, spp)
                view.measure(walk, scene, sensor, sampler, spp)
        self._views[key] = view
        if len(self._views) > _MOST_VIEWS:
            del self._views[next(iter(self._views))]
        return view

    def _tell_of_doubts(self, scene, optimized) -> bool:
        """Warns of gradients that are not the image's own, once for each set of parameters.
        Returns whether the set is new."""
        if optimized in self._told:
            return False
        self._told.add(optimized)
        for sentence in doubtful_gradients(scene):
            mi.Log(mi.LogLevel.Warn, f'"{self.name}": {sentence}.')
        return True

    def _tell_of_zeros(self, params, grad_in) -> None:
        """Warns of parameters that have not received a gradient, although the loss depends on the
        image."""
        zeros = without_gradients(params)
        if zeros and dr.any(dr.ravel(grad_in) != 0):
            mi.Log(
                mi.LogLevel.Warn,
                f'"{self.name}": no sample of this pass has a gradient with respect to '
                f"{', '.join(zeros)}. Things that are not seen have none, nor have lobes whose "
                f"weight is 0: begin above 0. Mitsuba may have to be told of a parameter: after "
                f"dr.enable_grad(), assign it (params[key] = …) and call params.update().",
            )

    def prepare(self, sensor, seed=0, spp=0, aovs=()):
        width, height = film_extent(sensor.film())
        self._pixel_count, self._sensor = width * height, sensor
        seed = _opaque(seed)
        sampler, spp = super().prepare(sensor, seed, spp, list(aovs))
        if self._rough is not None:
            sampler = PairedNumbers.begin(sampler, seed)
        return sampler, spp

    def sample(self, mode, scene, sampler, ray, δL=None, state_in=None, active=True, **_others):
        lanes = dr.width(ray)
        pixel = dr.arange(mi.UInt32, lanes) // (lanes // self._pixel_count)
        # "moment" calls this without prepare()
        medium = None if self._sensor is None else self._sensor.get_medium()
        rays = CameraRays(ray, pixel, medium=medium)
        walk = self._replayed(scene, self._sensor or scene.sensors()[0])
        if mode == dr.ADMode.Primal:
            sample, gathered = walk.first(scene, sampler, rays, active)
            return sample.L, sample.valid, [], gathered
        δL = δL if mode == dr.ADMode.Backward else None
        sample, replay = walk.again(scene, sampler, rays, state_in, δL, active)
        L = sample.L if mode == dr.ADMode.Backward else replay.derivative
        return L, sample.valid, [], None

    def _replayed(self, scene, sensor) -> ReplayedWalk:
        return ReplayedWalk(
            self._for_gradients.remembered(scene, sensor), self._flights, self._fills_gaps,
            self._mirrors, self._masks, self._rough,
        )  # fmt: skip


def _opaque(seed: mi.UInt32 | int) -> mi.UInt32:
    """A seed that is not a part of kernels."""
    seed = mi.UInt32(seed)
    dr.make_opaque(seed)
    return seed
