"""Depth of field by filtering an image that is rendered from the middle of the lens."""

from __future__ import annotations

import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from mitsuba_ext.bases.wrapping_integrator import WrappingIntegrator
from mitsuba_ext.estimators.defocus.filters import FILTERS
from mitsuba_ext.estimators.defocus.layered_job import LayeredJob
from mitsuba_ext.estimators.defocus.pinhole import LensCentre
from mitsuba_ext.estimators.defocus.thin_lens import ThinLens
from mitsuba_ext.images.denoising import denoiser
from mitsuba_ext.rendering.render import render
from mitsuba_ext.rendering.stages import ChangedSchedule, Schedule, Stage
from mitsuba_ext.scene.movers import is_moving_camera
from mitsuba_ext.startup import registry
from mitsuba_ext.transport.path_decisions import SceneQuery
from mitsuba_ext.transport.queries.scene import scene_query
from mitsuba_ext.util.parameters import MOST_SPP

#: The sensors whose rays begin in the middle of a lens, or can begin there.
_SENSORS = ("ThinLensCamera", "PerspectiveCamera")


@registry.plugin
class EffectiveCircleOfConfusion(WrappingIntegrator):
    r"""
    .. _integrator-ecoc_dof:

    Effective circle of confusion (:monosp:`ecoc_dof`)
    --------------------------------------------------

    Renders with a nested integrator from the centre of the lens, and computes depth of field from
    that image with a filter. This biased approximation needs a fraction of the samples. A near,
    blurred object hides a part of the lens from the objects behind its edge, which makes these
    objects sharper and shifts them; the filter reproduces this.

    .. pluginparameters::

     * - aperture_radius, focus_distance
       - |float|
       - Aperture radius and focus distance of the lens, in units of the scene; with 0, the sensor's
         own, if the sensor is a :monosp:`thinlens`. (Default: 0)
     * - filter
       - |string|
       - :monosp:`lens` computes, for each of several points of the lens, which layer hides which.
         :monosp:`effective` is the filter of the source: a separable filter for near surfaces, and
         a smaller and shifted circle of confusion for all others. (Default: lens)
     * - hidden_spp
       - |int|
       - Samples per pixel for surfaces that are hidden, or outside the film, but seen by a part of
         the lens; 0 for half of the image's samples per pixel. (Default: 0)
     * - denoise
       - |bool|
       - Whether to denoise the layers before they are filtered (with Open Image Denoise, from the
         package :monosp:`mitsuba-oidn`), except for pixels that show a light. The layers then use a
         box reconstruction filter. (Default: false)
     * - (Common parameters)
       - |float|
       - The parameters of :class:`StagedIntegrator`: timeout, checkpoint.
     * - (Nested plugin)
       - |integrator|
       - The integrator to render with, exactly one: any that samples camera rays, such as
         :monosp:`path`, :monosp:`volpath` or an integrator of this package. Its own
         :monosp:`timeout` is ignored.

    **Use it when** you want a preview, an animation or a look, and most noise comes from defocus.
    **Not when** the image must be correct: use :monosp:`path` with a :monosp:`thinlens`. The page
    ``docs/results/ecoc_dof.md`` of the source tree has figures, and pictures that show where it is
    wrong.

    **Layers.** There are up to five layers: two in front of the focus, one in focus, two behind it;
    fewer if all surfaces are blurred alike. One ray per pixel determines the boundaries between
    them. Each sample of the nested integrator belongs to the layer of the first surface that its
    ray hits. Around edges, further samples find what this surface hides. Their rays begin behind
    it, where the blur is half as large (behind the focus, halfway to the blur of the sky), and pass
    through the back of the same shape. Remaining gaps are filled with the colours around them.
    Neighbouring layers share the surfaces near the boundary between them.

    **The filter** :monosp:`lens` looks up each layer, for each pixel and 48 points of the lens, at
    the position where that point sees it; nearer layers cover the layers behind them. It uses
    copies of lower resolution where the blur is large, and fewer points where all circles of
    confusion are small. Small bright spots, such as a lamp at night, are instead spread over their
    circle of confusion, where nearer layers let their light through. The time of the filter does
    not depend on the number of samples. With :monosp:`effective` there are three layers. The near
    one is blurred with a single radius, the median radius of its surfaces.

    **Where it errs.** Objects seen in mirrors and through glass are blurred as much as the mirror
    or the glass itself. The layers ignore surfaces that let most light through (:monosp:`mask`,
    :monosp:`thindielectric`). Only the first hidden surface is known. Highlights depend on the
    direction, but are rendered from the centre of the lens only. Boundaries between layers lie at
    gaps in the distribution of blur; a hedge, for example, has no such gap. Samples outside the
    film extend to a quarter of its longer edge; beyond that, the filter repeats the border. Where
    the image is in focus, the noise of the nested integrator remains.

    The sensor must be a :monosp:`thinlens`, or a :monosp:`perspective` with both parameters given.
    Any film except :monosp:`specfilm` is accepted, with any filter and crop window. Output
    variables (:monosp:`aovs`) are rendered from the centre of the lens, and not blurred. The
    sensor's samples (:monosp:`spp`) are used for the image; the samples of ``hidden_spp`` are
    additional, and are taken even after the :monosp:`timeout`. Integrators that add light to pixels
    other than the pixel of the camera ray are refused (:monosp:`light_tracer`, Markov chains, and
    :monosp:`bdpt` unless its :monosp:`light_image` is off). Of our integrators, only
    :monosp:`variance` can nest it. Nested in :monosp:`moment` or :monosp:`aov`, it returns the
    unfiltered samples of its nested integrator. Gradients are not supported (use
    :class:`composed_prb`).

    Source: J. J. Guo, PhD thesis, TU Delft, chapter 5, Eqs. 5.1 to 5.5 (:monosp:`effective`). The
    filter :monosp:`lens`, more than three layers and hidden surfaces in them are ours. The source
    shifts the circle by α times the effective radius. Geometrically, the shift is α times the full
    radius, which is what :monosp:`effective` uses.

    .. tabs::
        .. code-tab:: xml

            <integrator type="ecoc_dof">
                <integrator type="path">
                    <integer name="max_depth" value="8"/>
                </integrator>
            </integrator>

        .. code-tab:: python

            'type': 'ecoc_dof',
            'nested': {
                'type': 'path',
                'max_depth': 8
            }
    """

    missing_in_samples = "a filter makes its picture; nest the other integrator in it"

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.aperture_radius, self.focus_distance = (
            self.parameter(props, key, 0.0, none="of the sensor", minimum=0.0)
            for key in ("aperture_radius", "focus_distance")
        )
        self.filter = self.parameter(props, "filter", "lens", choices=tuple(FILTERS))
        self.hidden_spp = self.parameter(
            props, "hidden_spp", 0, none="half", minimum=0, maximum=MOST_SPP
        )
        self.denoise = self.parameter(props, "denoise", False)
        if self.denoise:
            denoiser()
        self.refuse_equal_samples("the layers of {nested} cannot be rendered one by one")
        if self._is_staged and self.nested.has_expressions:
            raise NotImplementedError(
                f'"{self.name}": the parameter "aovs" of "{self.nested.name}" has light path '
                f"expressions, but output variables are not blurred as the image is: use a "
                f'"thinlens" and "{self.nested.name}" alone'
            )

    def accepts(self, nested: mi.SamplingIntegrator) -> bool:
        return not self.is_of_this_kind(nested)

    @property
    def needs_equal_samples(self) -> str:
        return "a filter makes its picture"

    def render_once(self, request):
        return render(self, request, LayeredJob)

    def schedule(self, request, samples, learning) -> Schedule:
        return _FromTheMiddle(super().schedule(request, samples, learning))

    # ---- What the job asks for ----

    def thin_lens(self, sensor: mi.Sensor) -> ThinLens:
        """The lens of a sensor.

        Raises:
            ValueError: The sensor has no lens and the scene gives none, or it focuses at infinity.
            NotImplementedError: The sensor's rays do not begin in a point, or it moves.
        """
        if is_moving_camera(sensor):
            raise NotImplementedError(
                f'"{self.name}": the sensor moves, so that a pixel has no single depth: use '
                f'"composed_path"'
            )
        if sensor.class_name() not in _SENSORS:
            raise NotImplementedError(
                f'"{self.name}": the sensor "{sensor.class_name()}" has no lens: use a "thinlens", '
                f'or a "perspective"'
            )
        # Not its methods: Mitsuba's integrators that nest ours pass a sensor without its own class
        parameters = mi.traverse(sensor)
        own = {"aperture_radius": self.aperture_radius, "focus_distance": self.focus_distance}
        for key, value in own.items():
            if value == 0 and key not in parameters:
                raise ValueError(
                    f'"{self.name}": the sensor "{sensor.class_name()}" has no "{key}": use a '
                    f'"thinlens", or give the parameter here'
                )
            own[key] = value or float(dr.slice(parameters[key]))
        if not math.isfinite(own["focus_distance"]):
            # Mitsuba's sensor would make rays of NaN from it
            raise ValueError(
                f'"{self.name}": the sensor "{sensor.class_name()}" has the "focus_distance" '
                f'{own["focus_distance"]}: give a finite one, as large as you like'
            )
        angle = float(dr.slice(parameters["x_fov"]))
        return ThinLens(**own, fov=angle, film_width=int(sensor.film().size()[0]))

    def scene_query(self, scene: mi.Scene) -> SceneQuery:
        """How rays are intersected with the scene, moving shapes included."""
        return scene_query(scene)

    def hidden_samples(self, spp: int) -> int:
        """Samples per pixel for surfaces that the image does not show: hidden, or outside of the
        film."""
        return self.hidden_spp or max(1, spp // 2)


class _FromTheMiddle(ChangedSchedule):
    """A schedule whose camera rays begin in the middle of the lens."""

    def changed(self, stage: Stage) -> Stage:
        return replace(stage, camera=replace(stage.camera, aperture=LensCentre()))
