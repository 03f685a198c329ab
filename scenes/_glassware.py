"""The tumbler of water_glass.xml and its water, and the fluted globe of mirrored_lamp.xml."""

from __future__ import annotations

import numpy as np
from _geometry import Floats, Mesh, lathe, rounded

#: The radius of the tumbler's inside at its rim and at its bottom, and the thickness of its wall.
RIM, BOTTOM, WALL = 0.036, 0.03, 0.003
#: Heights: of the rim, of the water, of the inside's bottom.
HEIGHT, LEVEL, FLOOR = 0.11, 0.075, 0.012
#: How far the water climbs at the wall, and in what width.
CLIMB, WIDTH = 0.0025, 0.0025


def _inside(z: float) -> float:
    """The radius of the inside at a height."""
    return BOTTOM + (RIM - BOTTOM) * (z - FLOOR) / (HEIGHT - FLOOR)


def tumbler() -> dict[str, Mesh]:
    """Three surfaces that meet where the water ends: glass against air, glass against water, water
    against air. The first two face away from the glass, the third one up."""
    outside = [(0, 0), (BOTTOM + WALL, 0), (RIM + WALL, HEIGHT), (RIM, HEIGHT)]
    # Points close to the corners keep them, but rounded
    corners = [_between(outside[k], outside[k + 1], t) for k in range(3) for t in (0.0, 0.03, 0.97)]
    water_line = (_inside(LEVEL), LEVEL)
    air = rounded([*corners, outside[3], _between(outside[3], water_line, 0.03), water_line])
    bottom = (_inside(FLOOR), FLOOR)
    wet = rounded(
        [water_line, _between(water_line, bottom, 0.9), bottom, (0.02, FLOOR), (0, FLOOR)]
    )
    wet = [_between(water_line, tuple(wet[1]), t) for t in (0, 0.25, 0.5, 0.75)] + [*wet[1:]]
    edge = _inside(LEVEL)
    from_wall = np.concatenate([np.linspace(0, 4 * WIDTH, 17), [0.5 * edge, edge]])
    height = LEVEL - CLIMB * (1 - np.exp(-from_wall / WIDTH))
    top = np.stack([edge - from_wall, height], axis=1)
    around = 96
    return {
        "tumbler": lathe(air, around),
        "tumbler_wet": lathe(wet, around),
        "tumbler_water": lathe(top, around),
    }


def _between(a: tuple, b: tuple, t: float) -> tuple[float, float]:
    return a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])


def globe() -> Mesh:
    """A sphere of radius 1 around the origin with twelve flutes from pole to pole, 6 % deep."""
    polar = np.linspace(0, np.pi, 49)
    profile = np.stack([np.sin(polar), -np.cos(polar)], axis=1)
    profile[[0, -1], 0] = 0
    mesh = lathe(profile, 144)
    x, y, z = mesh.positions.T
    wave: Floats = np.cos(12 * np.arctan2(y, x)) * (1 - z**2) ** 2
    return Mesh(mesh.positions * (1 - 0.03 * (1 - wave))[:, None], mesh.faces)
