"""Images of an optimization, with the last step as a control variate."""

from __future__ import annotations

from textwrap import indent
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsuba_ext.rendering.camera import find_sensor
from mitsuba_ext.rendering.recursive_estimate import RecursiveEstimate
from mitsuba_ext.rendering.turns import in_turn
from mitsuba_ext.scene.mark import SceneMark
from mitsuba_ext.scene.nesting import refuse_checkpoint
from mitsuba_ext.startup import registry
from mitsuba_ext.util.parameters import read_parameter


# Not a CppADIntegrator: "aov" and "moment" would call its sample(). They refuse this one.
@registry.plugin
class ControlVariate(mi.AdjointIntegrator):
    r"""
    .. _integrator-control_variate:

    Recursive control variates (:monosp:`control_variate`)
    ------------------------------------------------------

    Makes the images of an optimization less noisy, and with them its gradients: the image of the
    last step is corrected by the difference of two renders, before and after the parameters
    changed, which have the same random numbers and hence almost the same noise. For use with
    :monosp:`mi.render(scene, params, integrator=…)`, around an integrator that computes gradients.

    .. pluginparameters::

     * - max_sensors
       - |int|
       - Most sensors whose last images are kept. If more are used in turn, there is no gain.
         (Default: 64)
     * - (Nested plugin)
       - |integrator|
       - The integrator to render with, at most one: :monosp:`composed_prb`, :monosp:`prb`,
         :monosp:`prbvolpath`, :monosp:`direct_projective`, or another one that computes gradients.
         (Default: :monosp:`composed_prb` with :monosp:`next_event` = :monosp:`contribution` and
         :monosp:`gradient_samples` = :monosp:`loss`)
     * - max_depth, rr_depth, hide_emitters
       - |int|, |int|, |bool|
       - Parameters of the default integrator, accepted only without a nested one. (Default: as in
         :monosp:`composed_prb`)

    **Use it when** you optimize with few samples in each step, and parameters change by a few
    percent. **Not when** noise does not matter, or parameters change a lot from step to step: each
    step renders the image twice, so that a step with gradients takes up to a third more time. A
    single image gains nothing.

    **The image.** Step i renders the scene with the random numbers that step i-1 has announced, and
    with the numbers of the next step. With :math:`f_i` and :math:`h_{i+1}`, its image is

    .. math:: F_i = f_i + α_i (F_{i-1} - h_i)

    The weights α lie between 0 and 1 and minimize the variance of each pixel and channel, which is
    estimated from earlier steps. Where the parameters no longer change, :math:`F_i` is the mean of
    all steps; where all changes, it is :math:`f_i`. It has the expected value of the nested
    integrator's image. Unlike it, single pixels can be negative: use
    :monosp:`dr.maximum(image, 0)` before a logarithm or a root. The errors of successive images are
    correlated. Gradients are the nested integrator's, from random numbers of their own.

    **Sensors.** Each sensor has an image of its own, so that several can take turns; a film that
    changes its size or crop window, another number of samples or another scene begins anew.
    :monosp:`forget()` begins anew with all sensors. A sensor that moves has no gain, and no bias.
    What is kept of a sensor takes 32 bytes for each pixel and channel.

    **Random numbers.** The first step uses the :monosp:`seed` of :monosp:`mi.render`. Each step
    derives the seed of the next one from its own :monosp:`seed`, so that equal loops give equal
    images. Pass another seed in each step.

    **Learning.** A nested :monosp:`composed_prb` learns at the same intervals as without it (its
    :monosp:`learn_every` counts both renders of a step), from a render of its own. With several
    sensors, let it learn once (:monosp:`learn_every` = 0): all of them begin anew when it learns.
    Integrators that learn in each render, such as :monosp:`neepp`, gain nothing.

    :monosp:`nested` is the nested integrator, and :monosp:`weight` has the weights α of the last
    render, as a tensor. The sensor's film holds the second render of the nested integrator.
    Scalar variants are not supported.

    Source: B. Nicolet, F. Rousselle, J. Novák, A. Keller, W. Jakob, T. Müller, *Recursive Control
    Variates for Inverse Rendering*, ACM Transactions on Graphics 42(4), 2023.

    .. tabs::
        .. code-tab:: xml

            <integrator type="control_variate">
                <integer name="max_depth" value="6"/>
            </integrator>

        .. code-tab:: python

            'type': 'control_variate',
            'max_depth': 6
    """

    def __init__(self, props: mi.Properties) -> None:
        # Without properties, because the base class would read some that have no effect here
        super().__init__(mi.Properties(props.plugin_name()))
        self.name = props.plugin_name()
        self.max_sensors = read_parameter(self.name, props, "max_sensors", 64, minimum=1)
        self.nested = self._nested(props)
        self.forget()

    def _nested(self, props: mi.Properties) -> mi.Integrator:
        children = [child for _, child in props.objects()] or [_default(props)]
        # type(self), because the name is another class once another variant is selected
        if (
            len(children) != 1
            or not isinstance(children[0], mi.Integrator)
            or isinstance(children[0], type(self))
        ):
            found = ", ".join(child.class_name() for child in children)
            raise ValueError(
                f'"{self.name}": at most one integrator that computes gradients, such as '
                f'"composed_prb" or "prb", must be nested in it; found {found}'
            )
        nested = children[0]
        refuse_checkpoint(self.name, nested)
        if 0 < (renders := getattr(nested, "learn_every", 0)) < 3:
            raise ValueError(
                f'"{self.name}": the nested "{nested.name}" must use what it learns in at least '
                f'3 renders, or learn once: set its "learn_every" to 0, or to 3 or more, found '
                f"{renders}"
            )
        return nested

    # ---- What users call ----

    @property
    def statistics(self) -> Any:
        """The nested integrator's, of its last render; ``None`` if it has none."""
        return getattr(self.nested, "statistics", None)

    def forget(self) -> None:
        """Begins anew: the next render of each sensor has no control variate."""
        self._views: dict[int, _View] = {}
        self.weight = mi.TensorXf()

    # ---- What Mitsuba calls ----

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        if not develop:
            raise ValueError(
                f'"{self.name}": the film cannot hold the image, so develop must be True'
            )
        sensor = find_sensor(scene, sensor)
        with in_turn(self, sensor), dr.suspend_grad():
            # Not in the dictionary while it renders: an interrupted step is forgotten
            view = self._views.pop(sensor.ptr, None)
            if view is None or not view.shows(scene, sensor, spp):
                view = _View(scene, sensor, spp, seed)
            rendered = self.nested.render(scene, sensor, view.seed, spp)
            dr.eval(rendered)
            if view.learned is not self._learned:
                view.estimate = RecursiveEstimate()
            image = view.estimate.add(rendered)

            seeds = mi.sample_tea_32(mi.UInt32(seed), _NEXT)
            self._learn_in_time(scene, sensor, seeds[1], spp)
            view.seed, view.learned = seeds[0], self._learned
            view.estimate.prepare(self.nested.render(scene, sensor, view.seed, spp))

            self.weight = view.estimate.weight
            self._views[sensor.ptr] = view
            if len(self._views) > self.max_sensors:
                del self._views[next(iter(self._views))]
            return image

    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        return self.nested.render_forward(scene, params, find_sensor(scene, sensor), seed, spp)

    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        self.nested.render_backward(
            scene, params, grad_in, find_sensor(scene, sensor), seed, spp
        )

    def aov_names(self) -> list[str]:
        return self.nested.aov_names()

    def to_string(self) -> str:
        return f"{self.name}[\n  nested = {indent(str(self.nested), '  ').lstrip()}\n]"

    # ---- Helpers ----

    @property
    def _learned(self) -> Any:
        """What the nested integrator has learned: while it is the same object, renders with the
        same random numbers take the same paths."""
        return getattr(self.nested, "learned", None)

    def _learn_in_time(
        self, scene: mi.Scene, sensor: mi.Sensor, seed: mi.UInt32, spp: int
    ) -> None:
        """Lets the nested integrator learn now, if it would in one of the next two renders, which
        must make the same decisions."""
        if hasattr(self.nested, "learns_within") and self.nested.learns_within(2):
            self.nested.forget()
            self.nested.render(scene, sensor, seed, spp)


#: The second number from which the seed of the next step is derived. Mitsuba derives seeds for
#: gradients from 1.
_NEXT = 0x637626C5


def _default(props: mi.Properties) -> mi.Integrator:
    """The integrator that is nested if the scene names none."""
    nested = mi.Properties("composed_prb")
    nested["next_event"], nested["gradient_samples"] = "contribution", "loss"
    for key in ("max_depth", "rr_depth", "hide_emitters"):
        if key in props:
            nested[key] = props[key]
    return mi.PluginManager.instance().create_object(nested)


class _View:
    """What is known of a sensor.

    Attributes:
        seed: The seed of the next render.
        learned: What the nested integrator knew in the last render.
        estimate: The estimate of the image.
    """

    def __init__(self, scene: mi.Scene, sensor: mi.Sensor, spp: int, seed: Any) -> None:
        # Holds the sensor, so that no other one gets its address
        self._scene, self._sensor = SceneMark(scene), sensor
        self._samples = _samples(sensor, spp)
        self.seed, self.learned, self.estimate = seed, None, RecursiveEstimate()

    def shows(self, scene: mi.Scene, sensor: mi.Sensor, spp: int) -> bool:
        """Whether a render has the same pixels and samples."""
        return self._scene.is_of(scene) and self._samples == _samples(sensor, spp)


def _samples(sensor: mi.Sensor, spp: int) -> tuple[Any, ...]:
    film = sensor.film()
    return (
        spp or sensor.sampler().sample_count(), tuple(film.size()), tuple(film.crop_size()),
        tuple(film.crop_offset()), film.sample_border(), mi.variant(),
    )  # fmt: skip
