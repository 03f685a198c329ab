"""Shapes that move while the shutter is open."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mitsuba_ext.bases.moving_emitter import MovingEmitter
from mitsuba_ext.scene.bounds import shape_bounds
from mitsuba_ext.scene.motion.motion_parameters import read_motion
from mitsuba_ext.scene.motion.rigid_motion import Motion
from mitsuba_ext.scene.placeholder import span
from mitsuba_ext.startup import registry


@registry.plugin
class Moving(mi.Mesh):
    r"""
    .. _shape-moving:

    Moving shapes (:monosp:`moving`)
    --------------------------------

    Moves the nested shapes together, as a rigid body, while the shutter is open. The integrators of
    this package render their motion blur, including its shadows, reflections and indirect light.

    .. pluginparameters::

     * - (nested plugin)
       - |shape|
       - The shapes that move, one or more, of any type, with their materials. Before the motion,
         they rest in their own poses. Together with an :monosp:`instance`, nest its
         :monosp:`shapegroup` (or a :monosp:`ref` to it) as well.
     * - translate
       - |vector|
       - The total displacement, at constant velocity. (Default: 0, 0, 0)
     * - axis
       - |vector|
       - The axis about which they rotate, at constant speed; it need not be of unit length.
         (Default: none)
     * - angle
       - |float|
       - The total rotation in degrees; it may exceed 360. Required with :monosp:`axis`.
     * - center
       - |point|
       - A point on the axis, before the motion; it is displaced with the shapes. Accepted only with
         :monosp:`axis`. (Default: 0, 0, 0)
     * - begin, end
       - |float|
       - When the motion begins and ends, in the units of the sensor's :monosp:`shutter_open` and
         :monosp:`shutter_close`. (Default: 0 and 1)
     * - pose_0, pose_1, …
       - |transform|
       - In place of the parameters above: rotations and translations through which the shapes pass.
         They are applied after the shapes' own :monosp:`to_world`. Between the poses, positions of
         the origin are interpolated linearly, and rotations by slerp (the shorter way).
     * - time_0, time_1, …
       - |float|
       - The times of the poses, one for each pose, in increasing order.

    **Use it when** something moves or turns visibly between the sensor's :monosp:`shutter_open` and
    :monosp:`shutter_close`, which must be set: both are 0 by default, and such a sensor sees the
    shapes where they are at time 0. Before and after the motion, the shapes rest at its start and
    end pose. **Not when** shapes deform: that is not supported. For a moving camera, use
    :monosp:`moving_camera`; for lights without a surface, :monosp:`moving_light`.

    **Lights.** One of the nested shapes may be an area light, of any type of emitter and shape.
    Connections sample it in its pose at the time of the path, and MIS weights use the densities at
    that time. A second light needs its own :monosp:`moving`, with the same motion. Methods that
    divide lights into parts do not divide this light. :monosp:`spatial_lights` has probabilities
    for each eighth of the shutter interval, and uses the light's positions in it;
    :monosp:`next_event` = :monosp:`linear` uses the bounds of its whole motion. Integrators that
    start paths from lights refuse moving lights: :monosp:`bdpt`, :monosp:`light_tracer`,
    :monosp:`mlt`, and :monosp:`erpt` and :monosp:`pssmlt` if they are bidirectional.

    Only integrators of this package render these shapes. **Mitsuba's own**, such as :monosp:`path`
    or :monosp:`aov`, **render the scene without them, and we cannot make them refuse it**
    (connections still sample a light among them, with a wrong weight); use :monosp:`composed_path`,
    which is otherwise the same as :monosp:`path`.

    The parameter :monosp:`aovs` of our integrators evaluates them at the time of each ray, in world
    space (:monosp:`shape_index` is the number of the nested shape), so the film receives their mean
    over the shutter interval. For the values at a single time, open and close the shutter at that
    time.

    Every motion costs time: its shapes have their own acceleration structure, which all rays that
    hit the bounding box of the motion traverse. Compared with the same shapes at rest, one motion
    took 1.15 to 1.3 times as long, and four motions 1.3 to 1.6 times (less if the boxes are small
    in the view, more if they fill it). Put shapes that move together into one :monosp:`moving`.

    In :monosp:`cuda_*` variants, our integrators refuse scenes with moving shapes: Dr.Jit traces
    the rays of a kernel in one scene only.

    A nested shape must not appear elsewhere in the scene. Sensors, and meshes with vertex
    attributes, cannot be nested, and a medium in moving shapes must be homogeneous. The scene's
    bounds include all of the motion. :monosp:`mi.traverse` does not show nested shapes: it shows a
    placeholder mesh in their place. Textures that depend on the position in the world do not move
    along. An instance of a group that contains a :monosp:`merge` of rectangles may be cut off,
    because Mitsuba 3.9.1 does not know its bounds.

    Source: R. L. Cook, T. Porter, L. Carpenter, *Distributed Ray Tracing*, 1984; K. Shoemake,
    *Animating Rotation with Quaternion Curves*, 1985 (slerp).

    .. tabs::
        .. code-tab:: xml

            <shape type="moving">
                <vector name="translate" value="0.4, 0, 0"/>
                <vector name="axis" value="0, 0, 1"/>
                <float name="angle" value="90"/>
                <shape type="cube"/>
            </shape>

        .. code-tab:: python

            'type': 'moving',
            'pose_0': mi.ScalarTransform4f().rotate([0, 0, 1], 20),
            'time_0': 0.0,
            'pose_1': mi.ScalarTransform4f().translate([0.4, 0, 0]),
            'time_1': 1.0,
            'what': {'type': 'cube'}
    """

    #: Kept here, because the module's name becomes the class of the variant that was selected last
    _emitter = MovingEmitter

    def __init__(self, props: mi.Properties) -> None:
        self.name = props.plugin_name()
        self.children = self._nested(props)
        self.motion = read_motion(self.name, props)
        self.light = self._light()
        self._at_rest = None
        # The base class gets no parameters: those that it accepts have no meaning here
        own = mi.Properties(self.name)
        own.set_id(props.id())
        if self.light is not None:
            own["emitter"] = self._emitter(self.name, self.light, self.motion)
        super().__init__(self.name, vertex_count=3, face_count=2, props=own)
        span(self, *self.motion.bounds(self._corners()))

    @property
    def at_rest(self) -> mi.Scene:
        """The nested shapes alone, in the frame in which they rest."""
        if self._at_rest is None:
            shapes = {f"shape_{i}": child for i, child in enumerate(self.children)}
            names = [child.id() for child in self.children]
            try:
                self._at_rest = mi.load_dict({"type": "scene", **shapes}, optimize=False)
                for child, name in zip(self.children, names):
                    child.set_id(name)  # which Mitsuba replaces by the key
            except RuntimeError as error:
                if not any(child.class_name() == "Instance" for child in self.children):
                    raise
                raise self._error(
                    "next to a nested instance, its shapegroup must be nested too: as it is, or by "
                    "<ref> to one that the scene holds"
                ) from error
        return self._at_rest

    def to_string(self) -> str:
        times = self.motion.times
        return (
            f"{self.name}[\n  shapes = {len(self.children)},\n  begin = {times[0]:g},\n"
            f"  end = {times[-1]:g},\n  segments = {len(times) - 1}\n]"
        )

    # ---- What is nested ----

    def _nested(self, props: mi.Properties) -> list[mi.Shape]:
        children = []
        for key, child in props.objects():
            if not isinstance(child, mi.Shape):
                raise self._error(
                    f'what moves must be a shape, found {child.class_name()} ("{key}"); materials '
                    f"belong into the nested shapes"
                )
            if isinstance(getattr(child, "motion", None), Motion):
                raise self._error('a "moving" shape cannot be nested in another one')
            if hasattr(child, "lightweight"):
                raise self._error(f'a "{child.name}" cannot move; nest the mesh itself')
            self._refuse_what_cannot_move(child)
            children.append(child)
        if not any(map(_has_extent, children)):
            raise self._error("nothing is nested in it that could move; put a shape into it")
        return children

    def _light(self) -> mi.Emitter | None:
        lights = [child.emitter() for child in self.children if child.is_emitter()]
        if len(lights) > 1:
            raise self._error(
                f"{len(lights)} of the nested shapes are lights: nest each into a moving shape of "
                f"its own, with the same motion"
            )
        return lights[0] if lights else None

    def _refuse_what_cannot_move(self, child: mi.Shape) -> None:
        if child.is_sensor():
            raise self._error(
                "sensors of shapes cannot move: put this shape into the scene itself, at rest"
            )
        if child.is_mesh():
            reserved = ("vertex_positions", "vertex_normals", "vertex_texcoords")
            attributes = [key for key in mi.traverse(child).keys() if key.startswith("vertex_")]
            attributes = [key for key in attributes if key not in reserved]
            if attributes:
                # Mitsuba interpolates them at the point in world space, but the vertices are at
                # rest
                raise self._error(
                    f'the vertex attribute "{attributes[0]}" of a nested mesh does not work on '
                    f"what moves: use a texture"
                )

    def _corners(self) -> np.ndarray:
        boxes = [shape_bounds(child) for child in self.children if _has_extent(child)]
        return np.array([list(box.corner(i)) for box in boxes for i in range(8)], dtype=np.float64)

    # ---- Helpers ----

    def _error(self, text: str) -> ValueError:
        return ValueError(f'"{self.name}": {text}')


def _has_extent(shape: mi.Shape) -> bool:
    """Whether the shape itself occupies space. A shapegroup does so only through its instances."""
    return shape.class_name() != "ShapeGroupPlugin" and shape_bounds(shape).valid()
