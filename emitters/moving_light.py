"""Point lights, spots and projectors that move while the shutter is open."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.bases.moving_emitter import MovingEmitter
from mitsuba_ext.scene.motion.motion_parameters import read_motion
from mitsuba_ext.scene.movers import is_moving_light
from mitsuba_ext.scene.nesting import class_name
from mitsuba_ext.startup import registry


@registry.plugin
class MovingLight(MovingEmitter):
    r"""
    .. _emitter-moving_light:

    Moving light (:monosp:`moving_light`)
    -------------------------------------

    Moves a nested point light, spot light or projector rigidly while the shutter is open. Each path
    sees the emitter in its pose at the time of the path.

    .. pluginparameters::

     * - (nested plugin)
       - |emitter|
       - The emitter that moves, exactly one: :monosp:`point`, :monosp:`spot` or
         :monosp:`projector`. Before the motion, it rests in its own pose.
     * - pose_0, pose_1, …
       - |transform|
       - Rotations and translations through which the emitter passes. They are applied after its own
         :monosp:`to_world` or :monosp:`position`. Between the poses, positions of the origin are
         interpolated linearly, and rotations by slerp (the shorter way).
     * - time_0, time_1, …
       - |float|
       - The times of the poses, one for each pose, in increasing order, in the units of the
         sensor's :monosp:`shutter_open` and :monosp:`shutter_close`.
     * - translate, axis, angle, center, begin, end
       - |vector|, |float|
       - In place of poses: a displacement and a rotation at constant speed; see :monosp:`moving`.

    **Use it when** such a light moves visibly between the sensor's :monosp:`shutter_open` and
    :monosp:`shutter_close`, which must be set. Before and after the motion, the light rests at its
    start and end pose. **Not when** the light has a surface: nest a shape with an area light in
    :monosp:`moving`, which moves both.

    All integrators that connect paths to lights can use it, including Mitsuba's. Integrators that
    start paths from lights refuse it: :monosp:`bdpt`, :monosp:`light_tracer`, :monosp:`mlt`, and
    :monosp:`erpt` and :monosp:`pssmlt` if they are bidirectional. Two methods choose lights by
    their positions: :monosp:`spatial_lights` uses its positions during each eighth of the shutter
    interval, and :monosp:`next_event` = :monosp:`linear` uses the bounds of its whole motion.
    ``sampling_weight`` is taken from the nested emitter, and cannot be changed after loading;
    :monosp:`mi.traverse` shows its other parameters under their usual names.

    Errors: other emitters are refused, and so are poses that scale.

    Source: R. L. Cook, T. Porter, L. Carpenter, *Distributed Ray Tracing*, 1984; K. Shoemake,
    *Animating Rotation with Quaternion Curves*, 1985 (slerp).

    .. tabs::
        .. code-tab:: xml

            <emitter type="moving_light">
                <vector name="translate" value="0.4, 0, 0"/>
                <emitter type="point">
                    <point name="position" value="0, 0, 2"/>
                </emitter>
            </emitter>

        .. code-tab:: python

            'type': 'moving_light',
            'axis': [0, 0, 1],
            'angle': 90.0,
            'what': {'type': 'spot'}
    """

    def __init__(self, props: mi.Properties) -> None:
        name = props.plugin_name()
        children = [child for _key, child in props.objects()]
        at_point = mi.EmitterFlags.DeltaPosition
        if (
            len(children) != 1
            or not isinstance(children[0], mi.Emitter)
            or not mi.has_flag(children[0].flags(), at_point)
        ):
            found = ", ".join(map(class_name, children)) or "none"
            raise ValueError(
                f'"{name}": exactly one emitter must be nested in it, a "point", "spot" or '
                f'"projector" (an area light moves with its shape, in "moving"); found {found}'
            )
        if is_moving_light(children[0]):
            raise ValueError(f'"{name}": a moving light cannot be nested in another one')
        super().__init__(name, children[0], read_motion(name, props), props.id())
