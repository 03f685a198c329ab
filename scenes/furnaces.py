"""The exact answers of the furnace scenes; the scene files contain the derivations.

    for furnace in FURNACES:
        for region in furnace.regions:
            exact = region.exact(max_depth)  # None where no closed form is known

Radiance is grey, and the same in every variant (`*_mono`, `*_rgb`, `*_spectral`). Films must be
square; the reconstruction filter of the scenes is `box`. Needs the standard library only.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).parent


@dataclass(frozen=True)
class Region:
    """A rectangle of the film, in fractions of its width and height from the upper left corner.

    `exact(max_depth)` is the mean radiance over the region, with Mitsuba's meaning of `max_depth`
    (1: emission only, -1: no limit), or None where no exact value is known.
    `uniform(max_depth)` says whether each pixel has that value, not only the mean.
    `allowance` is the largest rounding error of Mitsuba's own float arithmetic, besides the noise.
    """

    exact: Callable[[int], float | None]
    uniform: Callable[[int], bool]
    allowance: float = 0.0
    left: float = 0.0
    top: float = 0.0
    right: float = 1.0
    bottom: float = 1.0

    def pixels(self, width: int, height: int) -> tuple[slice, slice]:
        """The (rows, columns) of a film that lie in the region entirely."""
        rows = slice(math.ceil(self.top * height), math.floor(self.bottom * height))
        columns = slice(math.ceil(self.left * width), math.floor(self.right * width))
        return rows, columns


@dataclass(frozen=True)
class Furnace:
    """A scene file and the regions of its film whose radiance is known."""

    file: str
    regions: tuple[Region, ...]

    @property
    def path(self) -> Path:
        return FOLDER / self.file


def _everywhere(max_depth: int) -> bool:
    return True


def _on_average(max_depth: int) -> bool:
    return False


def _without_limit(max_depth: int) -> bool:
    return max_depth == -1


def closed_diffuse(emission: float, albedo: float, max_depth: int) -> float:
    """Radiance in a closed room whose mean emission and albedo are the same on every wall."""
    bounces = math.inf if max_depth == -1 else max_depth
    return emission * (1 - albedo**bounces) / (1 - albedo)


def convex_body(albedo: float, max_depth: int) -> float:
    """Radiance of a convex diffuse body under a constant environment of radiance 1."""
    return 0.0 if 0 <= max_depth < 2 else albedo


def fresnel(cosine: float, ior: float) -> float:
    """Unpolarised reflectance of a smooth dielectric of relative index `ior` > 1, from outside."""
    inner = math.sqrt(1 - (1 - cosine * cosine) / (ior * ior))
    parallel = (ior * cosine - inner) / (ior * cosine + inner)
    perpendicular = (cosine - ior * inner) / (cosine + ior * inner)
    return (parallel * parallel + perpendicular * perpendicular) / 2


def glass_sphere(
    max_depth: int, ior: float = 1.5, distance: float = 4.0, fov: float = 40.0
) -> float:
    """Film mean of a glass sphere, `distance` radii away, before an environment of radiance 1.

    A pixel at the fraction s of the sphere's disc in the film looks in the direction of tangent
    s * t_max; the sphere is met at sin(incidence) = distance * sin(direction).
    """
    if max_depth == -1:
        return 1.0
    t_max = 1 / math.sqrt(distance * distance - 1)
    disc = math.pi * (t_max / (2 * math.tan(math.radians(fov / 2)))) ** 2
    # Midpoint rule in the angle of incidence, which keeps the integrand smooth at the rim
    steps, missing = 20_000, 0.0
    for i in range(steps):
        incidence = (i + 0.5) * math.pi / 2 / steps
        sine = math.sin(incidence) / distance
        slope = 2 * math.sin(incidence) * math.cos(incidence) / (distance * (1 - sine * sine)) ** 2
        lost = 1.0
        if max_depth > 1:
            reflectance = fresnel(math.cos(incidence), ior)
            lost = (1 - reflectance) * reflectance ** (max_depth - 2)
        missing += lost * slope / (t_max * t_max) * math.pi / 2 / steps
    return 1 - disc * missing


def isothermal(max_depth: int) -> float | None:
    """1 without a depth limit. With a limit there is no closed form (the radiance is at most 1)."""
    return 1.0 if max_depth == -1 else None


FURNACES = (
    Furnace(
        "furnace_box.xml", (Region(lambda depth: closed_diffuse(1.0, 0.6, depth), _everywhere),)
    ),
    Furnace(
        "furnace_convex.xml",
        (
            Region(
                lambda depth: convex_body(0.7, depth),
                _everywhere,
                left=0.3,
                top=0.3,
                right=0.7,
                bottom=0.7,
            ),
            Region(lambda depth: 1.0, _everywhere, right=0.1, bottom=0.1),
        ),
    ),
    Furnace("furnace_glass.xml", (Region(glass_sphere, _without_limit, allowance=1e-4),)),
    Furnace(
        "furnace_lamps.xml", (Region(lambda depth: closed_diffuse(0.5, 0.5, depth), _on_average),)
    ),
    Furnace("furnace_isothermal.xml", (Region(isothermal, _without_limit),)),
)
