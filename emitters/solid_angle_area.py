"""Area lights that are sampled by solid angle."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.bases.area_luminaire import AreaLuminaire
from mitsuba_ext.startup import registry


@registry.plugin
class SolidAngleArea(AreaLuminaire):
    r"""
    .. _emitter-solid_angle_area:

    Area light, sampled by solid angle (:monosp:`solid_angle_area`)
    ---------------------------------------------------------------

    An area light for a shape, which emits like Mitsuba's :monosp:`area`, but is sampled
    differently: a connection samples a direction in the solid angle that the light subtends at the
    illuminated point, instead of a point on the light's surface.

    .. pluginparameters::

     * - radiance
       - |spectrum| or |texture|
       - Emitted radiance, in W/(m² sr). (Default: 1)
     * - sampling
       - |string|
       - Directions are sampled by :monosp:`solid_angle`, or by :monosp:`projected` solid angle,
         which includes the cosine with the normal of the illuminated surface (rectangles only).
         (Default: solid_angle)
     * - sampling_weight
       - |float|
       - How often the light is chosen, relative to other lights. (Default: 1)

    **Use it when** a light is large, or close to the objects it illuminates: a panel over a table,
    a strip along a wall. **Not when** its texture has a small bright part (:monosp:`area` samples
    the texture; this emitter samples directions only), or when the integrator learns from parts of
    lights: :monosp:`neepp`, :monosp:`two_stage_lights`, :monosp:`learned_lights` and
    :monosp:`resampled_lights` divide lights of type :monosp:`area`, but not of this type; nor for
    hundreds of small lights: each adds about 3 ms to every pass.

    All integrators can use it, including Mitsuba's, and light paths start from it.

    - :monosp:`rectangle` (also sheared), and meshes of up to 16 triangles: directions are uniformly
      distributed. A mesh chooses among the triangles that face the point, in proportion to their
      solid angles; samples are lost if its triangles hide each other.
    - :monosp:`disk`: uniform up to a factor between 1 and 1.21. A disk that to_world turns into an
      ellipse, and meshes of more triangles, are sampled by area, as with :monosp:`area`.
    - :monosp:`sphere`: uniformly in its cone, as with :monosp:`area`; by area if the sphere shines
      inwards and the point is inside.

    In each of these cases, MIS uses the same density. If directions are sampled, the weight of a
    sample is therefore at most 1.21 times the radiance times the solid angle.

    :monosp:`projected` gives less noise than :monosp:`solid_angle` on surfaces that are not smooth,
    above all on surfaces at right angles to the light, but a sample takes longer; do not use it for
    distant lights. The part of the light above the horizon of the surface, and the part below it
    (emitters do not know from which side the surface is seen), are sampled in proportion to the
    absolute cosine with its geometric normal. A tenth of the samples are taken by
    :monosp:`solid_angle`. Weights are therefore at most ten times as large as with
    :monosp:`solid_angle`, even where shading normals or transmission let in light for which the
    cosine does not account. For lights whose projected solid angle is less than 1e-3, and for
    points in media, :monosp:`solid_angle` is used.

    On meshes with interpolated normals, light leaves on the side of the interpolated normal, as
    rays see it; densities do not depend on these normals. Gradients propagate to the radiance, but
    not to the shape.

    Errors: other shapes are refused in the first render, and so is :monosp:`projected` on shapes
    other than :monosp:`rectangle`.

    Source: J. Arvo in H. W. Jensen et al., *Monte Carlo Ray Tracing*, SIGGRAPH 2003 course 44,
    sections 4.3 and 4.4; C. Peters, *BRDF Importance Sampling for Polygonal Lights*, ACM TOG 40(4),
    2021, for a form of J. Arvo, *Stratified Sampling of Spherical Triangles*, 1995, without angles;
    disks after I. Guillén et al., *Area-Preserving Parameterizations for Spherical Ellipses*, 2017,
    with a closed form instead of the elliptic integral.

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

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        sampling = props.get("sampling", "solid_angle")
        if sampling not in ("solid_angle", "projected"):
            raise ValueError(
                f'"{self.name}": sampling must be "solid_angle" or "projected", found "{sampling}"'
            )
        self.is_projected = sampling == "projected"
