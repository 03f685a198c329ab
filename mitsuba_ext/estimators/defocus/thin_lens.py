"""The blur of scene points through a thin lens."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass(frozen=True)
class ThinLens:
    """A thin lens in front of a film.

    Light that reaches the pixel x through the point u of the unit disk (the aperture) crosses the
    depth z at a point that the centre of the lens sees at the position x + u · blur(z). A point is
    therefore blurred to a disk, its circle of confusion, with the radius \\|blur(z)\\|.

    Attributes:
        aperture_radius: The radius of the aperture, in scene units.
        focus_distance: The depth of surfaces in focus along the lens axis; may be infinite.
        fov: The horizontal field of view of the whole film, in degrees.
        film_width: The width of the whole film, not of a crop window, in pixels.
    """

    aperture_radius: float
    focus_distance: float
    fov: float
    film_width: int

    def __post_init__(self) -> None:
        for name, accepted in (
            ("aperture_radius", 0 <= self.aperture_radius < math.inf),
            ("focus_distance", self.focus_distance > 0),
            ("fov", 0 < self.fov < 180),
            ("film_width", self.film_width >= 1),
        ):
            if not accepted:
                raise ValueError(f'a thin lens cannot have "{name}" = {getattr(self, name)}')

    @property
    def pixels_per_disparity(self) -> float:
        """The distance in pixels between the images of a point at inverse depth 1, seen from the
        edge and from the centre of the aperture, with the focus at infinity."""
        width = 2 * math.tan(math.radians(self.fov) / 2)
        return self.aperture_radius * self.film_width / width

    @property
    def blur_of_sky(self) -> float:
        """:meth:`blur` at infinity."""
        return -self.pixels_per_disparity / self.focus_distance

    def blur(self, depth: mi.Float) -> mi.Float:
        """The signed radius of the circle of confusion in pixels: positive for points nearer than
        the focus distance.

        Parameters:
            depth: Depth along the axis of the lens, positive; may be infinite.
        """
        # The reciprocal of infinity is not 0 in every backend
        return self.blur_at(dr.select(dr.isfinite(depth), dr.rcp(depth), 0))

    def blur_at(self, inverse_depth: mi.Float) -> mi.Float:
        """:meth:`blur` at 1 / ``inverse_depth``; 0 is infinity."""
        # Eq. 5.3 (Guo), on the film instead of on the focal plane, which is focus_distance away
        return self.pixels_per_disparity * inverse_depth + self.blur_of_sky
