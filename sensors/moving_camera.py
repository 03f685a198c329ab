"""A camera that moves while its shutter is open."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.scene.motion.motion_parameters import read_motion
from mitsuba_ext.scene.motion.rigid_motion import Motion, PoseTable
from mitsuba_ext.scene.nesting import class_name
from mitsuba_ext.startup import registry

#: Sensors of Mitsuba that cannot move, and why.
_REFUSED = {
    "DistantSensorImpl": "it has no place that could move",
    "IrradianceMeter": "it belongs to a shape",
}


@registry.plugin
class MovingCamera(mi.Sensor):
    r"""
    .. _sensor-moving_camera:

    Moving camera (:monosp:`moving_camera`)
    ---------------------------------------

    Moves the nested sensor rigidly while its shutter is open: a pan, a tracking shot, a shaken
    camera. Each ray is a ray of the nested sensor, in the sensor's pose at the time of the ray.

    .. pluginparameters::

     * - (nested plugin)
       - |sensor|
       - The sensor that moves, exactly one: :monosp:`perspective`, :monosp:`thinlens`,
         :monosp:`orthographic`, :monosp:`radiancemeter` or :monosp:`batch`. The film, the sampler
         and the shutter interval (:monosp:`shutter_open`, :monosp:`shutter_close`) belong to it, as
         they would without the motion.
     * - pose_0, pose_1, …
       - |transform|
       - Rotations and translations through which the sensor passes. They are applied after its own
         :monosp:`to_world`: a sensor without :monosp:`to_world` is in the poses themselves, which
         can be a :monosp:`lookat`. Between the poses, positions of the origin are interpolated
         linearly, and rotations by slerp (the shorter way).
     * - time_0, time_1, …
       - |float|
       - The times of the poses, one for each pose, in increasing order, in the units of the shutter
         interval.
     * - translate, axis, angle, center, begin, end
       - |vector|, |float|
       - In place of poses: a displacement and a rotation at constant speed, which begin at the
         sensor's own :monosp:`to_world`; see :monosp:`moving`.

    **Use it when** the camera moves or turns visibly between :monosp:`shutter_open` and
    :monosp:`shutter_close`, which must be set: both are 0 by default, and such a sensor sees the
    scene from where it is at time 0. Before and after the motion, the camera rests at its start and
    end pose. **Not when** the lens or its focus changes during that time: this is not supported.

    All integrators can use it, including Mitsuba's, with any film, crop window and sampler, also
    together with :monosp:`moving` shapes. If light paths can be connected to the nested sensor,
    they are connected to the lens at the time of the path: :monosp:`light_tracer`, :monosp:`bdpt`
    and :monosp:`mlt` render with a moving :monosp:`perspective` or :monosp:`thinlens`, the first
    two also with a moving :monosp:`orthographic`. Mitsuba's
    :monosp:`ptracer` does so as well. :monosp:`ecoc_dof`, which needs a single depth for each
    pixel, refuses moving cameras.

    A camera ray costs an additional look-up in a small table and a rotation; kernels of other
    sensors are not affected. :monosp:`mi.traverse` shows the parameters of the nested sensor under
    their usual names. Its shutter interval cannot be changed after loading.

    Errors: other sensors are refused, and so are poses that scale.

    Source: R. L. Cook, T. Porter, L. Carpenter, *Distributed Ray Tracing*, 1984; K. Shoemake,
    *Animating Rotation with Quaternion Curves*, 1985 (slerp).

    .. tabs::
        .. code-tab:: xml

            <sensor type="moving_camera">
                <transform name="pose_0">
                    <lookat origin="0, -4, 1" target="-0.3, 0, 1" up="0, 0, 1"/>
                </transform>
                <float name="time_0" value="0"/>
                <transform name="pose_1">
                    <lookat origin="0, -4, 1" target="0.3, 0, 1" up="0, 0, 1"/>
                </transform>
                <float name="time_1" value="1"/>
                <sensor type="perspective">
                    <float name="shutter_close" value="1"/>
                </sensor>
            </sensor>

        .. code-tab:: python

            'type': 'moving_camera',
            'translate': [0.4, 0, 0],
            'what': {'type': 'perspective', 'shutter_close': 1.0}

    Attributes:
        nested (mi.Sensor): The nested sensor, in its rest frame.
        motion (Motion): The motion of this frame.
        poses (PoseTable): The motion as a table on the device.
    """

    def __init__(self, props: mi.Properties) -> None:
        self.name = props.plugin_name()
        self.nested = self._nested(props)
        self.motion = read_motion(self.name, props)
        self.poses = PoseTable([self.motion])
        own = mi.Properties(self.name)
        own.set_id(props.id())
        opening = self.nested.shutter_open()
        own["shutter_open"] = opening
        own["shutter_close"] = opening + self.nested.shutter_open_time()
        own["film"], own["sampler"] = self.nested.film(), self.nested.sampler()
        if (medium := self.nested.get_medium()) is not None:
            own["medium"] = medium
        super().__init__(own)
        self.m_needs_sample_3 = self.nested.needs_aperture_sample()

    def sample_ray(self, time, sample1, sample2, sample3, active=True):
        ray, weight = self.nested.sample_ray(time, sample1, sample2, sample3, active)
        return self.poses.pose(mi.UInt32(0), time).ray_to_world(ray), weight

    def sample_ray_differential(self, time, sample1, sample2, sample3, active=True):
        ray, weight = self.nested.sample_ray_differential(time, sample1, sample2, sample3, active)
        return self.poses.pose(mi.UInt32(0), time).ray_to_world(ray), weight

    def sample_direction(self, it, sample, active=True):
        pose = self.poses.pose(mi.UInt32(0), it.time)
        at_rest = mi.Interaction3f(it)
        at_rest.p = pose.point_to_rest(it.p)
        ds, weight = self.nested.sample_direction(at_rest, sample, active)
        ds.p, ds.d, ds.n = pose.point_to_world(ds.p), pose.rotation @ ds.d, pose.rotation @ ds.n
        ds.time = it.time
        return ds, weight

    def sample_wavelengths(self, si, sample, active=True):
        return self.nested.sample_wavelengths(si, sample, active)

    def bbox(self):
        return self.motion.box(self.nested.bbox())

    def traverse(self, callback):
        self.nested.traverse(callback)

    def parameters_changed(self, keys):
        if "shutter_open" in keys or "shutter_open_time" in keys:
            raise NotImplementedError(
                f'"{self.name}": the shutter interval cannot be changed after loading'
            )
        self.nested.parameters_changed(keys)

    def to_string(self):
        times = self.motion.times
        nested = str(self.nested).replace("\n", "\n  ")
        return (
            f"{self.name}[\n  begin = {times[0]:g},\n  end = {times[-1]:g},\n"
            f"  segments = {len(times) - 1},\n  nested = {nested}\n]"
        )

    # ---- Helpers ----

    def _nested(self, props: mi.Properties) -> mi.Sensor:
        children = [child for _key, child in props.objects()]
        if len(children) != 1 or not isinstance(children[0], mi.Sensor):
            found = ", ".join(map(class_name, children)) or "none"
            raise ValueError(
                f'"{self.name}": exactly one sensor must be nested in it, with film and sampler '
                f"inside that sensor; found {found}"
            )
        nested = children[0]
        reason = _REFUSED.get(nested.class_name())
        if isinstance(getattr(nested, "motion", None), Motion):
            reason = "it moves already"
        if reason is not None:
            raise ValueError(
                f'"{self.name}": the sensor "{class_name(nested)}" cannot be nested in it: {reason}'
            )
        return nested
