"""Light tracing: paths from lights, each vertex of which is connected to the sensor."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.bases.walk_integrator import WalkIntegrator
from mitsuba_ext.estimators.light_paths.lens import LENS_SAMPLING, connectable, connectable_sensor
from mitsuba_ext.estimators.light_paths.light_media import outside_of
from mitsuba_ext.estimators.light_paths.light_side import light_emission
from mitsuba_ext.estimators.light_paths.light_tracer import LightTracer
from mitsuba_ext.estimators.light_paths.light_walk import LightWalk
from mitsuba_ext.estimators.light_paths.path_memory import bytes_of_connected_path
from mitsuba_ext.estimators.light_paths.sensor import ConnectableSensor
from mitsuba_ext.rendering.camera import check_takes_splats
from mitsuba_ext.rendering.device import SampleBytes
from mitsuba_ext.rendering.stages import OneStage
from mitsuba_ext.scene.bsdfs import refuse_clear_curves
from mitsuba_ext.scene.media import may_have_media
from mitsuba_ext.scene.movers import sensor_at_rest
from mitsuba_ext.startup import registry
from mitsuba_ext.transport.walk import Walk


@registry.plugin
class LightTracerIntegrator(WalkIntegrator):
    r"""
    .. _integrator-light_tracer:

    Light tracer (:monosp:`light_tracer`)
    -------------------------------------

    Traces paths from the lights and connects each of their vertices to the sensor. It renders the
    same image as :monosp:`path`, except for what it cannot see (below), and finds caustics that
    :monosp:`path` hardly ever finds.

    .. pluginparameters::

     * - lens_sampling
       - |string|
       - How a connection to a :monosp:`thinlens` chooses the point on the aperture:
         :monosp:`uniform`, or by :monosp:`visibility`, in the parts of the lens that nothing
         occludes. (Default: uniform)
     * - (Common parameters)
       - |several|
       - The parameters of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout,
         aovs, checkpoint.

    **Use it when** light reaches diffuse surfaces through glass or via mirrors (caustics), above
    all from small lamps, point and spot lights, or as an independent check of other integrators.
    **Not when** mirrors or glass matter in the image, or when most light goes where the camera does
    not look: a lamp far away, or a sky over a large scene. Images of scenes far from the origin
    differ from :monosp:`path` (by up to 8 % in a quarter of the image, in a scene moved by a
    thousand times its size); the page of :class:`bdpt` explains why.

    **What it cannot see.** A vertex cannot be connected to the sensor via a mirror, or through
    glass, masks and null surfaces (in scenes with media, the last two let light pass). Whatever the
    camera sees in a smooth mirror, through smooth glass, through a hole of a mask or through a null
    surface, is black; a warning says so if the scene has such materials. Emitters that the camera
    sees directly are rendered. Lights of type :monosp:`directionalarea`, which :monosp:`path` does
    not find, are also rendered (spectral variants refuse them).

    **Sensors and films.** The sensor must be a :monosp:`perspective`, :monosp:`thinlens` or
    :monosp:`orthographic`; others, such as a :monosp:`batch`, are refused. The film must be an
    :monosp:`hdrfilm`, with any filter and crop window, but without :monosp:`sample_border`.

    **lens_sampling.** With :monosp:`visibility`, depth maps from 16 or 64 pieces of the aperture
    are traced at the start of a render (at most 600 000 rays), and a table (at most 20 MiB) stores
    the pieces from which each part of the scene is visible. Connections prefer these pieces; the
    expected image stays the same. This helps if out-of-focus objects near the lens hide a part of
    it; otherwise, it only costs the time to make the maps. If the parallax is too small to be
    visible, it falls back to :monosp:`uniform`. With a sensor that has no aperture it has no
    effect, and a warning says so.

    For each sample of a pixel there is one camera ray, which sees emitters, and one light path. The
    emitter of a light path is chosen by power for one half of the paths, and by
    :monosp:`sampling_weight` for the other half. Surfaces and sky emit what :monosp:`path` sees,
    also in cases where Mitsuba's :monosp:`ptracer` is wrong: for rotated spheres and environment
    maps, lights with interpolated normals, textured lights, merged rectangles, normal and bump
    maps, filters at the film's edges. With the sampler :monosp:`ldsampler`, whose numbers depend on
    each other, light paths draw independent random numbers instead.

    Alpha and output variables come from the camera rays. Participating media are rendered as in
    :monosp:`volpath`, with the exceptions that the page of :class:`bdpt` lists; in scenes that have
    any, vertices are connected to the sensor through index-matched surfaces and masks as well.
    Curves whose BSDF transmits light, such as :monosp:`hair`, are refused (use :class:`bdpt`).
    Gradients are not supported (use
    :class:`composed_prb`); neither are scalar and polarized variants, nor nesting in
    :monosp:`moment` and :monosp:`aov`.

    Source: J. Arvo, *Backward Ray Tracing*, SIGGRAPH course, 1986; E. Veach, *Robust Monte Carlo
    Methods for Light Transport Simulation*, PhD thesis, 1997, section 10.2 (t = 1); adjoint BSDFs:
    section 5.3 there; J. J. Guo, PhD thesis, TU Delft, section 5.3.3, Algorithm 5 (aperture).

    .. tabs::
        .. code-tab:: xml

            <integrator type="light_tracer">
                <integer name="max_depth" value="8"/>
            </integrator>

        .. code-tab:: python

            'type': 'light_tracer',
            'max_depth': 8
    """

    has_light_paths = light_paths_see_media = True

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.lens_sampling = self.parameter(
            props, "lens_sampling", "uniform", choices=LENS_SAMPLING
        )
        self.fill(props)
        self._has_warned = False

    @property
    def sample_cost(self) -> int:
        return 2

    @property
    def sample_bytes(self) -> SampleBytes:
        return bytes_of_connected_path()

    @property
    def needs_equal_samples(self) -> str:
        return "its light paths find light for all pixels"

    def schedule(self, request, samples, learning) -> OneStage:
        scene, sensor = request.scene, request.sensor
        if not ConnectableSensor.can_connect(sensor):
            raise NotImplementedError(
                f'"{self.name}": nothing can be connected to the sensor '
                f'"{sensor_at_rest(sensor).class_name()}": '
                f'use a "perspective", "thinlens" or "orthographic", or the integrator "path"'
            )
        try:
            check_takes_splats(sensor.film())
        except NotImplementedError as error:
            raise NotImplementedError(f'"{self.name}": {error}') from None
        query = self.query(scene)
        target, walk = connectable(sensor), None
        if scene.emitters() and self.max_depth > 1:
            refuse_clear_curves(scene, f'"{self.name}"')
            self._warn_of_hidden(scene)
            emission = light_emission(self.name, scene)
            walk = LightWalk(
                emission, self.max_depth, self.rr_depth, query=query,
                outside=outside_of(self.name, query, scene, sensor), connects=True,
                channels=self.channels,
            )  # fmt: skip
            target = connectable_sensor(self.name, self.lens_sampling, scene, sensor, query)
        directly = Walk(
            min(self.max_depth, 1), self.rr_depth, self.hide_emitters, query=query,
            channels=self.channels,
        )  # fmt: skip
        return OneStage(LightTracer(directly, walk, target))

    def _warn_of_hidden(self, scene: mi.Scene) -> None:
        """Warns of surfaces that are black; only once, because this is called for every batch of a
        render."""
        hidden = int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.DeltaTransmission)
        masks = ", and through masks and null surfaces"
        if may_have_media(scene):
            masks = ""
        else:
            hidden |= int(mi.BSDFFlags.Null)
        is_there = any(s.bsdf() and int(s.bsdf().flags()) & hidden for s in scene.shapes())
        if is_there and not self._has_warned:
            self._has_warned = True
            mi.Log(
                mi.LogLevel.Warn,
                f'"{self.name}": what the camera sees in mirrors, through glass{masks}, is black.',
            )
