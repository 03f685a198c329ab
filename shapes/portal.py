"""Openings through which a room is lit."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mitsuba_ext.scene.portals import Portal
from mitsuba_ext.startup import registry


@registry.plugin
class PortalShape(mi.Mesh):
    r"""
    .. _shape-portal:

    Portals (:monosp:`portal`)
    --------------------------

    Marks a rectangular opening through which the environment lights a room: a window, a door, a
    skylight. The decision :monosp:`portal_lights` of :class:`composed_path` samples the part of the
    environment that is visible through it.

    .. pluginparameters::

     * - to_world
       - |transform|
       - Places the square from (−1, −1, 0) to (1, 1, 0), the same as for :monosp:`rectangle`, on
         the opening. Its normal (0, 0, 1) must point into the room. It must remain a rectangle.
         (Default: none, i.e. identity)

    **Use it when** an :monosp:`envmap`, a :monosp:`sunsky` or a :monosp:`constant` environment
    lights a closed room through an opening. **Not when** the camera is outdoors.

    It is not a surface: no ray hits it, and it does not change the images of other integrators.
    Make it as large as the opening, or a little larger: the part of the environment that is visible
    past its edge is still found, but with few samples. In a thick wall, place it at the outer edge.
    Panes of glass in the opening block connections to the environment, as always.

    Source: B. Bitterli, J. Novák, W. Jarosz, *Portal-Masked Environment Map Sampling*, Computer
    Graphics Forum 34(4), 2015.

    .. tabs::
        .. code-tab:: xml

            <shape type="portal">
                <transform name="to_world">
                    <scale x="0.6" y="0.7"/>
                    <rotate x="1" angle="90"/>
                    <translate x="2" y="4" z="1.5"/>
                </transform>
            </shape>

        .. code-tab:: python

            'type': 'portal',
            'to_world': mi.ScalarTransform4f().translate([2, 4, 1.5]).rotate([1, 0, 0], 90)
                .scale([0.6, 0.7, 1])
    """

    def __init__(self, props: mi.Properties) -> None:
        name = props.plugin_name()
        transform = props.get("to_world", mi.ScalarTransform4f())
        if not hasattr(transform, "matrix"):
            raise TypeError(f'"{name}": the parameter "to_world" must be a transform')
        try:
            self.portal = Portal.of_matrix(np.array(transform.matrix, dtype=np.float64))
        except ValueError as error:
            raise ValueError(f'"{name}": the parameter "to_world": {error}') from None
        # The base class gets no parameters: those that it accepts have no meaning here
        own = mi.Properties(name)
        own.set_id(props.id())
        super().__init__(name, vertex_count=4, face_count=2, props=own)
        # Two triangles without area, which no ray can hit, give the scene its bounds
        parameters = mi.traverse(self)
        parameters["vertex_positions"] = mi.Float(self.portal.corners.ravel().astype(np.float32))
        parameters["faces"] = mi.UInt32([0, 2, 2, 1, 3, 3])
        parameters.update()

    def to_string(self) -> str:
        p = self.portal
        return (
            f"portal[\n  center = {p.center.tolist()},\n"
            f"  size = {2 * p.half_width:g} x {2 * p.half_height:g},\n"
            f"  into_the_room = {(-p.outwards).tolist()}\n]"
        )
