"""Area lights whose radiance depends on the direction."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi

from mitsuba_ext.bases.area_luminaire import AreaLuminaire
from mitsuba_ext.scene.luminaires.ies import read_ies
from mitsuba_ext.scene.luminaires.profiles import AngularTable, PowerOfCosine
from mitsuba_ext.startup import registry


@registry.plugin
class GoniometricArea(AreaLuminaire):
    r"""
    .. _emitter-goniometric_area:

    Area light with an angular profile (:monosp:`goniometric_area`)
    ---------------------------------------------------------------

    An area light whose radiance depends on direction: by a power of the cosine with the normal, or
    by the intensities of a photometric file (IES). Each point of the surface has the same profile.

    .. pluginparameters::

     * - radiance
       - |spectrum| or |texture|
       - Radiance by which the profile is multiplied, in W/(m² sr). With an exponent, it is the
         radiance along the normal; with a file, the largest intensity divided by the area of the
         light. (Default: 1)
     * - exponent
       - |float|
       - The radiance is proportional to this power of the cosine, 0 or more. 0 is
         :monosp:`solid_angle_area`. (Default: 10)
     * - filename
       - |string|
       - Instead of exponent: a photometric file (IES LM-63, type C). Its vertical angle 0 is the
         normal, and its horizontal angle 0 the x axis of the shape. Light that leaves backwards
         (above 90°) is left out.
     * - sampling_weight
       - |float|
       - How often the light is chosen, relative to other lights. (Default: 1)

    **Use it when** a luminaire has louvres, lenses or a reflector that you do not want to model.
    **Not when** the beam is a few degrees wide and the light is large: connections sample all
    directions in which the light is visible, as with :monosp:`solid_angle_area`, and most of these
    are dark.

    All integrators can use it, including Mitsuba's, and light paths start from it
    (:monosp:`sample_ray` by the profile of an exponent; integrators of this package by the cosine).
    With a file, the radiance in a direction is the intensity divided by the projected area of the
    light. The projected area is assumed to be at least a tenth of the area, so the radiance stays
    finite at 90°.

    Errors: files that are not photometric; files whose intensities depend on the horizontal angle,
    on shapes other than :monosp:`rectangle` and :monosp:`disk`; shapes that
    :monosp:`solid_angle_area` refuses.

    Source: P. Shirley in H. W. Jensen et al., *Monte Carlo Ray Tracing*, SIGGRAPH 2003 course 44,
    section 3.2 (luminaires that are not diffuse); IESNA LM-63.

    .. tabs::
        .. code-tab:: xml

            <shape type="disk">
                <emitter type="goniometric_area">
                    <rgb name="radiance" value="5"/>
                    <float name="exponent" value="20"/>
                </emitter>
            </shape>

        .. code-tab:: python

            'type': 'disk',
            'emitter': {
                'type': 'goniometric_area',
                'radiance': {'type': 'rgb', 'value': 5.0},
                'exponent': 20.0
            }
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        if "filename" in props:
            if "exponent" in props:
                raise ValueError(f'"{self.name}": give either exponent or filename, not both')
            file = Path(str(mi.file_resolver().resolve(props["filename"])))
            if not file.is_file():
                raise ValueError(f'"{self.name}": filename: there is no file "{file}"')
            try:
                self._profile = AngularTable(read_ies(file))
            except ValueError as error:
                raise ValueError(f'"{self.name}": {error}') from error
        else:
            exponent = props.get("exponent", 10.0)
            if not 0 <= exponent < 1e6:
                raise ValueError(
                    f'"{self.name}": exponent must be at least 0 and less than 1e6, found '
                    f"{exponent:g}"
                )
            self._profile = PowerOfCosine(exponent)

    def profile(self, si):
        cos_turn, sin_turn = mi.Float(1), mi.Float(0)
        if self._profile.needs_axis:
            d, x = si.to_world(si.wi), self._axis()
            cos_turn = dr.dot(d, x)
            sin_turn = dr.dot(d, dr.cross(mi.Vector3f(si.sh_frame.n), x))
        return self._profile.eval(mi.Frame3f.cos_theta(si.wi), cos_turn, sin_turn)

    def _axis(self) -> mi.Vector3f:
        """The x axis of the shape."""
        shape = self.get_shape()
        if mi.ShapeType(int(shape.shape_type())) not in (
            mi.ShapeType.Rectangle, mi.ShapeType.Disk
        ):  # fmt: skip
            raise NotImplementedError(
                f'"{self.name}": the intensities of the file depend on the horizontal angle; give '
                f'the light to a rectangle or disk, not to a "{shape.class_name()}"'
            )
        return dr.normalize(mi.traverse(shape)["to_world"] @ mi.Vector3f(1, 0, 0))

    def sample_profile(self, sample):
        return self._profile.sample(sample)
