"""The pool of pool.xml: the surface of its water, the basin, and what is around it."""

from __future__ import annotations

import numpy as np
from _geometry import Floats, Mesh, box, join, quad

# Half of the basin's width and depth, the heights of its floor and of the water; z = 0 is the deck
HALF_X, HALF_Y, FLOOR, LEVEL = 1.2, 0.9, -0.55, -0.07
#: How far the water reaches into the walls, so that no light passes between them.
OVERLAP = 0.02
#: The amplitude of a wave over the square of its length, in 1/m: then all waves focus light at the
#: same depth.
STEEPNESS = 0.04


def waves(x: Floats, y: Floats) -> Floats:
    """The height of the water above its level: eight waves of 24 to 60 cm in random directions."""
    draw = np.random.Generator(np.random.PCG64(5))
    height = np.zeros_like(x)
    for k in range(8):
        length, angle = 0.24 * 2.5 ** (k / 7), 2 * np.pi * draw.random()
        along = (x * np.cos(angle) + y * np.sin(angle)) / length
        height += STEEPNESS * length**2 * np.sin(2 * np.pi * (along + draw.random()))
    return height


def water() -> Mesh:
    """A grid of quads of 2 cm; it faces up."""
    columns, rows = 122, 92
    x = np.linspace(-HALF_X - OVERLAP, HALF_X + OVERLAP, columns)
    y = np.linspace(-HALF_Y - OVERLAP, HALF_Y + OVERLAP, rows)
    x, y = np.meshgrid(x, y)
    positions = np.stack([x, y, LEVEL + waves(x, y)], axis=2).reshape(-1, 3)
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1, 1)
    right, above = first + 1, first + columns
    lower = np.concatenate([first, right, above + 1], axis=1)
    upper = np.concatenate([first, above + 1, above], axis=1)
    return Mesh(positions, np.concatenate([lower, upper]))


def basin() -> Mesh:
    """Floor and walls, which face the water; the texture repeats each 0.8 m."""
    wide, deep, high = np.diag([2 * HALF_X, 2 * HALF_Y, -FLOOR])
    corner, opposite = (-HALF_X, -HALF_Y, FLOOR), (HALF_X, HALF_Y, FLOOR)
    sides = [quad(corner, wide, deep, 1.25)]
    sides += [quad(corner, deep, high, 1.25), quad(corner, high, wide, 1.25)]
    sides += [quad(opposite, high, -wide, 1.25), quad(opposite, -deep, high, 1.25)]
    return join(*sides)


def deck() -> Mesh:
    """Boards on all sides of the basin; the texture repeats each 2 m."""
    reach = 4.0
    strips = [(-reach, -reach, reach, -HALF_Y), (-reach, HALF_Y, reach, reach)]
    strips += [(-reach, -HALF_Y, -HALF_X, HALF_Y), (HALF_X, -HALF_Y, reach, HALF_Y)]
    return join(*(quad((a, b, 0), (c - a, 0, 0), (0, d - b, 0), 0.5) for a, b, c, d in strips))


def coping() -> Mesh:
    """The stone rim of the basin."""
    inner_x, inner_y, wide = HALF_X - 0.015, HALF_Y - 0.015, 0.16
    low, high = -0.045, 0.03
    sides = []
    for s in (-1, 1):
        near, far = sorted((s * inner_y, s * (inner_y + wide)))
        sides.append(box((-inner_x - wide, near, low), (inner_x + wide, far, high), 0.01))
        near, far = sorted((s * inner_x, s * (inner_x + wide)))
        sides.append(box((near, -inner_y, low), (far, inner_y, high), 0.01))
    return join(*sides)


def pool() -> dict[str, Mesh]:
    """All but the water, which is written with interpolated normals."""
    return {"basin": basin(), "deck": deck(), "coping": coping()}
