"""Area lights that are sampled by solid angle."""

from __future__ import annotations

from mitsuba_ext import registry
from mitsuba_ext.luminaires.area_luminaire import AreaLuminaire


@registry.plugin
class SolidAngleArea(AreaLuminaire):
    r"""
    .. _emitter-solid_angle_area:

    Area light, sampled by solid angle (:monosp:`solid_angle_area`)
    ---------------------------------------------------------------

    The light of Mitsuba's :monosp:`area`, in its place on a shape, with other samples: connections
    choose among the directions in which the light is seen from the point that they start from, not
    among the points of its surface.

    .. pluginparameters::

     * - radiance
       - |spectrum| or |texture|
       - Emitted radiance, in W/(m² sr). (Default: 1)
     * - sampling_weight
       - |float|
       - How often the light is chosen, in proportion to the others. (Default: 1)

    **Use it when** a light is large or close, as seen from what it lights: a panel over a table, a
    strip along a wall. **Not when** its texture has a small bright part (:monosp:`area` samples the
    texture; here only directions are sampled), or when the integrator learns from parts of lights:
    :monosp:`neepp`, :monosp:`two_stage_lights`, :monosp:`learned_lights` and
    :monosp:`resampled_lights` divide the lights of :monosp:`area`, and take this one as a whole.

    All integrators can use it, those of Mitsuba too, and light paths start from it.

    - :monosp:`rectangle`, also sheared ones, and meshes of up to 16 triangles: directions are
      uniformly distributed. A mesh chooses among the triangles that face the point, in proportion
      to their solid angles; where its triangles hide each other, samples are lost.
    - :monosp:`disk`: uniform up to a factor between 1 and 1.21. A disk that to_world makes an
      ellipse, and meshes of more triangles, are sampled by area, as :monosp:`area` does.
    - :monosp:`sphere`: uniformly in its cone, as :monosp:`area` does; by area if the sphere shines
      inwards and the point is inside.

    The same density holds for MIS in each of these cases. So the weight of a sample is at most 1.21
    times the radiance times the solid angle. Interpolated normals turn the light of a mesh as rays
    see it, and have no part in densities. Gradients reach the radiance, but not the shape.

    Errors: other shapes are refused in the first render.

    Source: C. Peters, *BRDF Importance Sampling for Polygonal Lights*, ACM TOG 40(4), 2021, which
    is J. Arvo, *Stratified Sampling of Spherical Triangles*, 1995, in a stable form; disks after
    I. Guillén et al., *Area-Preserving Parameterizations for Spherical Ellipses*, 2017, with a
    closed form in the place of the elliptic integral.

    .. tabs::
        .. code-tab:: xml

            <shape type="rectangle">
                <emitter type="solid_angle_area">
                    <rgb name="radiance" value="5"/>
                </emitter>
            </shape>

        .. code-tab:: python

            'type': 'rectangle',
            'emitter': {
                'type': 'solid_angle_area',
                'radiance': {'type': 'rgb', 'value': 5.0}
            }
    """
