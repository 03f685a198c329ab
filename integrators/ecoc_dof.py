"""Depth of field by a filter of what the middle of the lens sees."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsuba_ext.composition.wrapping_integrator import WrappingIntegrator
from mitsuba_ext.decisions.query.moving_scene import scene_query
from mitsuba_ext.defocus.filters import FILTERS
from mitsuba_ext.defocus.thin_lens import ThinLens
from mitsuba_ext.images.denoising import denoiser
from mitsuba_ext.parameters import MOST_SPP
from mitsuba_ext.rendering.layered_job import LayeredJob
from mitsuba_ext.rendering.pinhole import LensCentre
from mitsuba_ext.rendering.render import render
from mitsuba_ext.rendering.stages import Schedule, Stage
from mitsuba_ext.scene.movers import is_moving_camera
from mitsuba_ext.startup import registry
from mitsuba_ext.transport.path_decisions import SceneQuery

#: The sensors whose rays begin in the middle of a lens, or can.
_SENSORS = ("ThinLensCamera", "PerspectiveCamera")


@registry.plugin
class EffectiveCircleOfConfusion(WrappingIntegrator):
    r"""
    .. _integrator-ecoc_dof:

    Effective circle of confusion (:monosp:`ecoc_dof`)
    --------------------------------------------------

    Renders with a nested integrator from the middle of the lens, and makes depth of field of that
    by a filter. It is biased: an approximation, in a fraction of the samples. What a near, blurred
    object hides of the lens makes far things behind its edge sharper and shifted; the filter shows
    that.

    .. pluginparameters::

     * - aperture_radius, focus_distance
       - |float|
       - Those of the lens, in units of the scene; 0 for those of the sensor, if that is a
         :monosp:`thinlens`. (Default: 0)
     * - filter
       - |string|
       - :monosp:`lens`: by points of the lens, what hides what. :monosp:`effective`: the source's,
         a separable filter of what is near, and a smaller and shifted circle of confusion for the
         rest. To compare with: :monosp:`gather` and :monosp:`one_pass`, of the picture alone.
         (Default: lens)
     * - hidden_spp
       - |int|
       - Samples per pixel of what is hidden, and of what lies around the film, where the lens sees
         it; 0 for half of the samples per pixel. (Default: 0)
     * - denoise
       - |bool|
       - Denoises the layers before they are filtered (Open Image Denoise, from the package
         :monosp:`mitsuba-oidn`), but for pixels that show a light. They are collected with a box
         filter then. (Default: false)
     * - (Common parameters)
       - |float|
       - Those of :class:`StagedIntegrator`: timeout, checkpoint.
     * - (Nested plugin)
       - |integrator|
       - The integrator to render with, exactly one: any that samples camera rays, such as
         :monosp:`path`, :monosp:`volpath` or one of ours. A :monosp:`timeout` of its own is
         ignored.

    **Use it when** a preview, an animation or a look is wanted, and defocus makes the noise.
    **Not when** the image must be right: use :monosp:`path` with a :monosp:`thinlens`.
    ``docs/results/ecoc_dof.md`` has figures, and pictures that show where it errs.

    **Layers.** There are up to five: two before the focus, one in focus, two behind; fewer where
    all things are blurred alike. One ray for each pixel tells where the limits between them are.
    Each sample of the nested integrator belongs to the layer of the surface that it meets first.
    Around edges, more samples begin behind that surface, where the blur is half as large (behind
    the focus, half of the way to that of the sky), and go on past the back of the same shape. Where
    nothing was found, colours from around are filled in. Layers share surfaces near the limits
    between them.

    **The filter** :monosp:`lens` looks, for each pixel and 48 points of the lens, into each layer
    at the place where that point sees it; what is nearer covers what is behind it. It uses copies
    of lower resolution where the blur is large, and fewer points where all circles are small. What
    is small and bright, such as a lamp at night, is spread over its circle instead, where nearer
    layers let it through. The time does not depend on the samples. With :monosp:`effective` there
    are three layers. The near one is blurred with one radius, the median of those of its surfaces.

    **Where it errs.** What is seen in mirrors and through glass is blurred as the mirror and the
    glass are. Surfaces that let most light through (:monosp:`mask`, :monosp:`thindielectric`) are
    not there for the layers. Of what is hidden, the first surface only is known. Highlights depend
    on the direction, and the lens sees them from its middle only. Layers are cut where blurs have a
    gap; in a hedge there is none. Samples outside of the film reach a quarter of its longer edge;
    beyond, all is as it is there. Noise of the nested integrator in what is in focus stays as it
    is.

    The sensor must be a :monosp:`thinlens`, or a :monosp:`perspective` with both parameters given.
    The film is any but a :monosp:`specfilm`, with any filter and crop window. Output variables
    (:monosp:`aovs`) are those from the middle of the lens, and not blurred. The samples of the
    sensor (:monosp:`spp`) are those of the image; those of ``hidden_spp`` come besides, after the
    :monosp:`timeout`. Integrators that bring light to other pixels than that of their camera ray
    are refused (:monosp:`light_tracer`, chains, and :monosp:`bdpt` unless its :monosp:`light_image`
    is off). It cannot be nested in another integrator of ours but :monosp:`variance`; inside of
    :monosp:`moment` and :monosp:`aov`, samples are those of the nested integrator, not filtered.
    Gradients are not supported (use :monosp:`prb`).

    Source: J. J. Guo, PhD thesis, TU Delft, chapter 5, Eqs. 5.1 to 5.5 (:monosp:`effective`). The
    filter :monosp:`lens`, more than three layers and what is hidden in them are ours. The source
    shifts by α times the effective radius; the geometry demands α times the whole one, which is
    what :monosp:`effective` does.

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

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.aperture_radius = self.parameter(props, "aperture_radius", 0.0, minimum=0.0)
        self.focus_distance = self.parameter(props, "focus_distance", 0.0, minimum=0.0)
        self.filter = self.parameter(props, "filter", "lens", choices=FILTERS)
        self.hidden_spp = self.parameter(props, "hidden_spp", 0, minimum=0, maximum=MOST_SPP)
        self.denoise = self.parameter(props, "denoise", False)
        if self.denoise:
            denoiser()
        self._is_rendering = False
        if reason := self.nested.needs_equal_samples if self._is_staged else "":
            raise ValueError(
                f'"{self.name}": the layers of "{self.nested.name}" cannot be rendered one by one: '
                f"{reason}"
            )

    def accepts(self, nested: mi.SamplingIntegrator) -> bool:
        # Not by class: once another variant is selected, the module's name is that one's class
        return not isinstance(nested, type(self))

    @property
    def needs_equal_samples(self) -> str:
        return "a filter makes its picture"

    def parameters(self) -> dict[str, Any]:
        return {
            "aperture_radius": self.aperture_radius or "of the sensor",
            "focus_distance": self.focus_distance or "of the sensor",
            "filter": self.filter,
            "hidden_spp": self.hidden_spp or "half",
            "denoise": self.denoise,
            "nested": str(self.nested).replace("\n", "\n  "),
        }

    def render_once(self, scene, sensor, seed, spp, develop, evaluate):
        self._is_rendering = True
        try:
            return render(self, scene, sensor, seed, spp, develop, evaluate, LayeredJob)
        finally:
            self._is_rendering = False

    def schedule(self, scene, sensor, samples, seed) -> Schedule:
        if not self._is_rendering:
            raise NotImplementedError(
                f'"{self.name}": a filter makes its picture: nest the other integrator in it, and '
                f"not the other way round"
            )
        return _FromTheMiddle(super().schedule(scene, sensor, samples, seed))

    # ---- What the job asks for ----

    def thin_lens(self, sensor: mi.Sensor) -> ThinLens:
        """The lens of a sensor.

        Raises:
            ValueError: It has none, and none is given; or it focuses at infinity.
            NotImplementedError: Its rays do not begin in a point, or it moves.
        """
        if is_moving_camera(sensor):
            raise NotImplementedError(
                f'"{self.name}": the sensor moves, and nothing has one depth: use "composed_path"'
            )
        if sensor.class_name() not in _SENSORS:
            raise NotImplementedError(
                f'"{self.name}": the sensor "{sensor.class_name()}" has no lens: use a "thinlens", '
                f'or a "perspective"'
            )
        # Not its methods: integrators of Mitsuba that nest ours pass a sensor without its class
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
            # Mitsuba's sensor makes rays of NaN of it
            raise ValueError(
                f'"{self.name}": the sensor "{sensor.class_name()}" has the "focus_distance" '
                f'{own["focus_distance"]}: give a finite one, as large as you like'
            )
        angle = float(dr.slice(parameters["x_fov"]))
        return ThinLens(**own, fov=angle, film_width=int(sensor.film().size()[0]))

    def scene_query(self, scene: mi.Scene) -> SceneQuery:
        """How the rays meet the scene."""
        return scene_query(scene)

    def hidden_samples(self, spp: int) -> int:
        """Samples per pixel of what the image does not show."""
        return self.hidden_spp or max(1, spp // 2)


class _FromTheMiddle:
    """A schedule whose camera rays begin in the middle of the lens."""

    def __init__(self, nested: Schedule) -> None:
        self._nested = nested

    def next_stage(self) -> Stage:
        stage = self._nested.next_stage()
        stage.camera.aperture = LensCentre()
        return stage
