"""Writes every mesh (PLY) and map (EXR) in `scenes/assets/` that the scene files use, and the
thousand lamps of many_lamps.xml.

    python scenes/make_assets.py [folder]

Needs numpy and the OpenEXR package. A second run writes the same bytes.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import OpenEXR
from _geometry import (
    Floats,
    Mesh,
    block,
    box,
    icosphere,
    join,
    lathe,
    perforated,
    quad,
    rounded,
    torus_knot,
    tube,
    write_ply,
)

# The house of rooms.xml and many_lamps.xml: rooms of 4 x 4 m and 2.7 m, walls 0.14 m thick
COLUMNS, ROWS, ROOM, HEIGHT, WALL = 4, 3, 4.0, 2.7, 0.14
DOOR_HEIGHT = 2.1
WALL_COLOURS = 4
INSIDE = ROOM - WALL

# The room of window.xml: its size, the thickness of its walls, and the windows in its south wall
WIDTH, DEPTH, TALL, THICK = 5.2, 4.0, 2.7, 0.24
WINDOWS, SILL, LINTEL = ((0.35, 2.05), (2.6, 4.3)), 0.6, 2.45


# --- things that stand around ------------------------------------------------------------------


def pot() -> dict[str, Mesh]:
    """A pot with lid, spout and handle, 0.2 m high."""
    body = rounded([(0, 0), (0.062, 0), (0.075, 0.004), (0.105, 0.06), (0.095, 0.13), (0.06, 0.15)])
    lid = rounded([(0.068, 0.148), (0.064, 0.156), (0.03, 0.17), (0.008, 0.174), (0.008, 0.182)])
    knob = rounded([(0.006, 0.178), (0.016, 0.184), (0.017, 0.196), (0.01, 0.204), (0, 0.204)])
    t = np.linspace(0, 1, 22)
    x, z = 0.085 + 0.115 * t - 0.03 * t**2, 0.05 + 0.03 * t + 0.075 * t**2
    spout = np.stack([x, 0 * t, z], axis=1)
    angle = np.radians(np.linspace(-75, 80, 24))
    x, z = -0.09 - 0.062 * np.cos(angle), 0.083 + 0.052 * np.sin(angle)
    handle = np.stack([x, 0 * angle, z], axis=1)
    parts = [lathe(body), lathe(lid), lathe(knob)]
    parts.append(tube(spout, 0.027 - 0.016 * t, up=(0, 1, 0)))
    parts.append(tube(handle, 0.0085, up=(0, 1, 0), around=12))
    return {"pot": join(*parts)}


def tableware() -> dict[str, Mesh]:
    """Everything else that a lathe can make."""
    vase = [(0, 0), (0.05, 0), (0.055, 0.005), (0.1, 0.1), (0.085, 0.2), (0.03, 0.26), (0.032, 0.3)]
    vase += [(0.05, 0.33), (0.045, 0.33), (0.026, 0.3), (0.024, 0.26), (0.07, 0.2), (0, 0.1)]
    bowl = [(0, 0), (0.05, 0), (0.055, 0.01), (0.11, 0.04), (0.135, 0.085), (0.13, 0.088)]
    bowl += [(0.105, 0.047), (0.05, 0.018), (0, 0.016)]
    # The glass is one closed surface, wall and all: a dielectric needs an inside
    glass = [(0, 0), (0.042, 0), (0.042, 0.004), (0.006, 0.01), (0.005, 0.02), (0.005, 0.09)]
    glass += [(0.02, 0.1), (0.042, 0.13), (0.044, 0.16), (0.035, 0.215), (0.034, 0.217)]
    glass += [(0.033, 0.215), (0.0415, 0.16), (0.0395, 0.13), (0.02, 0.106), (0, 0.102)]
    shade = [(0.2, 0), (0.12, 0.22), (0.118, 0.22), (0.198, 0)]
    dish = [(0, 0), (0.09, 0), (0.13, 0.014), (0.132, 0.017), (0.085, 0.007), (0, 0.006)]
    planter = [(0, 0), (0.13, 0), (0.17, 0.32), (0.155, 0.32), (0.15, 0.28), (0, 0.28)]
    return {
        "vase": lathe(rounded(vase)),
        "bowl": lathe(rounded(bowl), 48),
        "glass": lathe(rounded(glass), 48),
        "shade": lathe(shade),
        "dish": lathe(rounded(dish)),
        "planter": lathe(rounded(planter, 1)),
    }


def plant() -> dict[str, Mesh]:
    """Sixteen bent leaves that leave the ground together; turn by the golden angle."""
    leaves = []
    t = np.linspace(0, 1, 11)
    for k in range(16):
        length, lean = 0.62 + 0.3 * ((k * 7) % 16) / 16, 0.25 + 0.75 * k / 16
        reach = length * lean * (0.25 * t + 0.75 * t * t)
        rise = length * (1.25 - 0.5 * lean) * (t - 0.45 * lean * t * t)
        width = 0.055 * np.sin(np.pi * np.minimum(0.12 + 0.88 * t, 1)) ** 0.8
        edges = [np.stack([reach, side * width, rise], axis=1) for side in (-1, 1)]
        strip = np.stack(edges, axis=1)
        first = np.arange(10)[:, None] * 2
        faces = np.concatenate([first + [0, 2, 3], first + [0, 3, 1]])
        leaves.append(Mesh(strip.reshape(-1, 3), faces).turned(137.508 * k))
    return {"plant": join(*leaves)}


def furniture() -> dict[str, Mesh]:
    """Table, chair, sofa, a shelf, and its books in three colours. Fronts face -y."""
    legs = [
        box((x - 0.03, y - 0.03, 0), (x + 0.03, y + 0.03, 0.72))
        for x in (-0.62, 0.62)
        for y in (-0.33, 0.33)
    ]
    table = join(box((-0.7, -0.4, 0.72), (0.7, 0.4, 0.75), 0.008), *legs)
    parts = [box((-0.22, -0.22, 0.43), (0.22, 0.22, 0.47), 0.012)]
    for x in (-0.19, 0.19):
        parts.append(box((x - 0.02, -0.21, 0), (x + 0.02, -0.17, 0.43)))
        parts.append(box((x - 0.02, 0.17, 0), (x + 0.02, 0.21, 0.92)))
    parts += [box((-0.19, 0.175, z), (0.19, 0.2, z + 0.07)) for z in (0.6, 0.72, 0.84)]
    chair = join(*parts)
    shelf = [box((-0.5, -0.15, z), (0.5, 0.15, z + 0.03)) for z in (0.06, 0.46, 0.86, 1.26, 1.66)]
    shelf += [box((x - 0.015, -0.15, 0), (x + 0.015, 0.15, 1.72)) for x in (-0.5, 0.5)]
    shelf.append(box((-0.5, 0.14, 0.06), (0.5, 0.15, 1.66), 0.001))
    books: list[list[Mesh]] = [[], [], []]
    draw = np.random.Generator(np.random.PCG64(7))
    rows = [(0.09, -0.46, 0.2), (0.49, -0.1, 0.46), (0.89, -0.46, -0.05), (1.29, -0.2, 0.3)]
    for z, start, stop in rows:
        x = start
        while x < stop:
            wide, tall = 0.022 + 0.03 * draw.random(), 0.2 + 0.1 * draw.random()
            leaf = box((x, -0.11, z), (x + wide - 0.002, 0.1, z + tall), 0.003)
            books[int(3 * draw.random())].append(leaf)
            x += wide
    sofa = [
        box((-0.95, -0.42, 0.12), (0.95, 0.42, 0.3), 0.03),
        box((-0.95, 0.24, 0.28), (0.95, 0.44, 0.8), 0.06),
    ]
    sofa += [box((x - 0.1, -0.42, 0.12), (x + 0.1, 0.42, 0.58), 0.05) for x in (-0.9, 0.9)]
    sofa += [box((x - 0.39, -0.44, 0.3), (x + 0.39, 0.26, 0.46), 0.05) for x in (-0.4, 0.4)]
    meshes = {"table": table, "chair": chair, "shelf": join(*shelf), "sofa": join(*sofa)}
    return meshes | {f"books_{k}": join(*group) for k, group in enumerate(books)}


def door() -> dict[str, Mesh]:
    """A leaf of 0.9 x 2.04 m with four panels, hinged on the z axis, reaching along +x."""
    leaf = [box((0, -0.018, 0.005), (0.9, 0.018, 2.04), 0.003)]
    for x in (0.0, 0.39, 0.78):
        leaf.append(box((x, -0.026, 0.005), (x + 0.12, 0.026, 2.04), 0.006))
    for z, tall in ((0.005, 0.22), (0.86, 0.14), (1.9, 0.14)):
        leaf.append(box((0, -0.0255, z), (0.9, 0.0255, z + tall), 0.006))
    knob = lathe(
        rounded(
            [(0.026, 0), (0.026, 0.006), (0.01, 0.01), (0.01, 0.035), (0.026, 0.042)]
            + [(0.03, 0.06), (0.015, 0.07), (0, 0.07)]
        )
    )
    knobs = [knob.turned(side, axis=0).moved((0.84, 0, 1.02)) for side in (90, -90)]
    return {"door": join(*leaf), "knob": join(*knobs)}


def cupboard() -> dict[str, Mesh]:
    """0.9 m high, its two doors a hand's breadth apart; the front faces -y."""
    boards = [box((-0.43, -0.18, z), (0.43, 0.19, z + 0.02)) for z in (0.05, 0.46, 0.88)]
    boards += [box((x - 0.01, -0.18, 0), (x + 0.01, 0.19, 0.9)) for x in (-0.44, 0.44)]
    boards.append(box((-0.43, 0.18, 0.05), (0.43, 0.19, 0.9), 0.001))
    boards += [box((x - 0.2, -0.2, 0.05), (x + 0.2, -0.18, 0.9)) for x in (-0.25, 0.25)]
    return {"cupboard": join(*boards)}


def fittings() -> dict[str, Mesh]:
    """What lamps of many_lamps.xml hide in: a ledge along a wall, and a bowl on a pole."""
    ledge = [block((-1.7, -0.12, 0), (1.7, 0, 0.015))]
    ledge.append(block((-1.7, -0.12, 0.015), (1.7, -0.105, 0.07)))
    stand = [(0, 0), (0.14, 0), (0.14, 0.012), (0.014, 0.02), (0.014, 1.6), (0.15, 1.72)]
    stand += [(0.147, 1.722), (0.01, 1.61), (0, 1.61)]
    return {"ledge": join(*ledge), "stand": lathe(stand, 24)}


# --- the furnaces' walls -----------------------------------------------------------------------


def wall_with_holes() -> Mesh:
    """One face of furnace_lamps.xml: [-1, 1]^2 facing +z, minus the places of its two lamps."""
    xs, ys = [-1, -0.75, -0.625, 0, 0.5, 1], [-1, -0.5, 0, 0.5, 0.625, 1]
    return perforated(xs, ys, {(1, 3), (3, 1)})


# --- the house of rooms.xml and many_lamps.xml --------------------------------------------------


def opening(column: int, row: int, across: int) -> tuple[float, float] | None:
    """The doorway to the next room along axis `across`: where it begins and ends, or None."""
    if (column, row, across) in {(0, 1, 1), (2, 1, 0), (3, 0, 1)}:
        return None
    middle = ROOM * (0.3 + 0.4 * ((3 * column + 5 * row + 4 * across) % 7) / 6)
    if (column, row, across) == (1, 0, 1):
        middle = 1.1  # the doorway in the picture
    if (column, row, across) == (1, 0, 0):
        middle = 2.5
    return middle - 0.5, middle + 0.5


def wall_side(along: float, hole: tuple[float, float] | None) -> list[Mesh]:
    """A wall from x = 0 to `along` in the plane y = 0, facing -y, around its doorway."""
    if hole is None:
        return [quad((0, 0, 0), (along, 0, 0), (0, 0, HEIGHT))]
    left, right = hole
    return [
        quad((0, 0, 0), (left, 0, 0), (0, 0, HEIGHT)),
        quad((right, 0, 0), (along - right, 0, 0), (0, 0, HEIGHT)),
        quad((left, 0, DOOR_HEIGHT), (right - left, 0, 0), (0, 0, HEIGHT - DOOR_HEIGHT)),
        # the half of the reveal on this side
        quad((left, 0, 0), (0, WALL / 2, 0), (0, 0, DOOR_HEIGHT)),
        quad((right, WALL / 2, 0), (0, -WALL / 2, 0), (0, 0, DOOR_HEIGHT)),
        quad((left, WALL / 2, DOOR_HEIGHT), (right - left, 0, 0), (0, -WALL / 2, 0)),
    ]


def doorways(column: int, row: int) -> list[tuple[float, float] | None]:
    """Doorways in the north (+y), west (-x), south (-y) and east (+x) wall of a room: where they
    begin and end, from the left corner as seen from inside."""
    holes = [
        opening(column, row, 1) if row + 1 < ROWS else None,
        opening(column - 1, row, 0) if column > 0 else None,
        opening(column, row - 1, 1) if row > 0 else None,
        opening(column, row, 0) if column + 1 < COLUMNS else None,
    ]
    for turn, hole in enumerate(holes):
        # Seen from inside, a doorway's coordinate runs backwards on the south and east side
        if hole is not None:
            start, stop = hole[0] - WALL / 2, hole[1] - WALL / 2
            holes[turn] = (start, stop) if turn in (0, 1) else (INSIDE - stop, INSIDE - start)
    return holes


def house() -> dict[str, Mesh]:
    """Walls by colour, floor and ceiling; room (column, row) starts at 4 m times its indices."""
    colours: list[list[Mesh]] = [[] for _ in range(WALL_COLOURS)]
    for column in range(COLUMNS):
        for row in range(ROWS):
            for turn, hole in enumerate(doorways(column, row)):
                for part in wall_side(INSIDE, hole):
                    centred = part.moved((-INSIDE / 2, INSIDE / 2, 0)).turned(90 * turn)
                    at = ((column + 0.5) * ROOM, (row + 0.5) * ROOM, 0)
                    colours[(column + 2 * row) % WALL_COLOURS].append(centred.moved(at))
    width, depth = COLUMNS * ROOM, ROWS * ROOM
    meshes = {f"house_{k}": join(*parts) for k, parts in enumerate(colours)}
    for mesh in meshes.values():
        mesh.uv = None
    meshes["house_floor"] = quad((0, 0, 0), (width, 0, 0), (0, depth, 0), 0.5)
    meshes["house_ceiling"] = quad((0, depth, HEIGHT), (width, 0, 0), (0, -depth, 0))
    return meshes


# --- the room of window.xml --------------------------------------------------------------------


def window_room() -> dict[str, Mesh]:
    """Walls with an inside and an outside, so that no light gets in at the corners; one window's
    frame, its lower left corner at the origin; a curtain."""
    edges = [x for window in WINDOWS for x in window]
    holes = {(2 * k + 1, 1) for k in range(len(WINDOWS))}
    xs, zs = [-THICK, *edges, WIDTH + THICK], [-THICK, SILL, LINTEL, TALL + THICK]
    outside = perforated(xs, zs, holes).turned(90, axis=0).moved((0, -THICK, 0))
    inside = perforated([0, *edges, WIDTH], [0, SILL, LINTEL, TALL], holes).turned(90, axis=0)
    parts = [outside, Mesh(inside.positions, inside.faces[:, ::-1])]
    for left, right in WINDOWS:
        wide, high = (right - left, 0, 0), (0, 0, LINTEL - SILL)
        parts.append(quad((left, -THICK, SILL), wide, (0, THICK, 0)))
        parts.append(quad((left, 0, LINTEL), wide, (0, -THICK, 0)))
        parts.append(quad((left, -THICK, SILL), (0, THICK, 0), high))
        parts.append(quad((right, 0, SILL), (0, -THICK, 0), high))
    parts.append(quad((0, DEPTH, 0), (WIDTH, 0, 0), (0, 0, TALL)))
    parts.append(quad((0, 0, 0), (0, DEPTH, 0), (0, 0, TALL)))
    parts.append(quad((WIDTH, DEPTH, 0), (0, -DEPTH, 0), (0, 0, TALL)))
    shell = block((-THICK, -THICK, -THICK), (WIDTH + THICK, DEPTH + THICK, TALL + THICK))
    south = np.all(shell.positions[shell.faces][:, :, 1] < 0, axis=1)
    parts.append(Mesh(shell.positions, shell.faces[~south]))
    walls = join(*(Mesh(part.positions, part.faces) for part in parts))
    wide, high = WINDOWS[0][1] - WINDOWS[0][0], LINTEL - SILL
    bars = [box((x, -0.19, 0), (x + 0.05, -0.13, high)) for x in (0, wide - 0.05)]
    bars += [box((0, -0.19, z), (wide, -0.13, z + 0.05)) for z in (0, high - 0.05)]
    bars.append(box((wide / 2 - 0.03, -0.2, 0), (wide / 2 + 0.03, -0.12, high)))
    bars.append(box((0, -0.175, 1.22), (wide, -0.145, 1.25)))
    bars.append(box((-0.05, -0.13, -0.035), (wide + 0.05, 0.06, 0.003), 0.008))
    t = np.linspace(0, 1, 49)
    edge = np.stack([0.34 * t, -0.03 * np.cos(12 * np.pi * t), 0 * t], axis=1)
    strip = np.stack([edge, edge + [0, 0, 2.3]], axis=1).reshape(-1, 3)
    first = np.arange(48)[:, None] * 2
    faces = np.concatenate([first + [0, 2, 3], first + [0, 3, 1]])
    return {"window_walls": walls, "window_frame": join(*bars), "curtain": Mesh(strip, faces)}


# --- the lamps of many_lamps.xml ---------------------------------------------------------------

WARM, PLAIN = (1, 0.62, 0.26), (1, 0.82, 0.6)
TINTS = (WARM, WARM, PLAIN, PLAIN, (0.6, 0.8, 1), (1, 0.5, 0.45), (0.6, 1, 0.7))
FACING = {"up": None, "down": "180", "out": "90"}  # about x; "out" is away from a wall

# What stands at a wall: width, distances of its origin and its front from the wall, material
AT_WALLS = {
    "sofa": (2.0, 0.56, 1.0, "linen"),
    "shelf": (1.04, 0.16, 0.31, "paint"),
    "cupboard": (0.92, 0.2, 0.41, "oak"),
}


class Room:
    """The furniture and the lamps of one room, as lines of XML.

    A place at a wall (0 to 3: north, west, south, east) is so many metres along it, from its left
    corner as seen from inside, and so many out from it.
    """

    def __init__(self, column: int, row: int, draw: np.random.Generator) -> None:
        self.draw, self.lines = draw, [f"<!-- Room {column}, {row} -->"]
        self.middle = np.array([column + 0.5, row + 0.5]) * ROOM
        self.holes = doorways(column, row)
        self.places: dict[str, tuple[int, float]] = {}

    def between(self, low: float, high: float) -> float:
        return low + (high - low) * self.draw.random()

    def around(self, middle: Floats, reach: float) -> Floats:
        """A point in a square."""
        return middle + (self.between(-reach, reach), self.between(-reach, reach))

    def tint(self) -> tuple:
        return TINTS[int(len(TINTS) * self.draw.random())]

    def at(self, wall: int, along: float, out: float) -> Floats:
        """x and y in the house of a place at a wall."""
        x, y = along - INSIDE / 2, INSIDE / 2 - out
        c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[wall]
        return self.middle + (c * x - s * y, s * x + c * y)

    def find_place(self, width: float, out: float) -> tuple[int, float]:
        """A place at a wall that is not in the way of a doorway or of what stands there."""

        def corners(wall: int, left: float, right: float, out: float) -> Floats:
            return np.sort([self.at(wall, left, 0), self.at(wall, right, out)], axis=0)

        taken = [corners(k, *hole, 0.7) for k, hole in enumerate(self.holes) if hole]
        for name, (wall, along) in self.places.items():
            half, front = AT_WALLS[name][0] / 2, AT_WALLS[name][2]
            taken.append(corners(wall, along - half, along + half, front))
        free = []
        for wall in range(4):
            for along in np.arange(width / 2 + 0.05, INSIDE - width / 2, 0.1).tolist():
                low, high = corners(wall, along - width / 2, along + width / 2, out)
                if all(np.any(low > b) or np.any(high < a) for a, b in taken):
                    free.append((wall, along))
        return free[int(len(free) * self.draw.random())]

    def mesh(self, name: str, material: str, place: tuple, turn: float = 0) -> None:
        x, y, z = place
        self.lines.append(
            f'<shape type="ply"><string name="filename" value="assets/{name}.ply"/>'
            f'<transform name="to_world"><rotate z="1" angle="{turn:.3g}"/>'
            f'<translate value="{x:.3f}, {y:.3f}, {z}"/></transform><ref id="{material}"/></shape>'
        )

    def lamp(
        self,
        kind: str,
        size: tuple[float, float],
        radiance: tuple[float, float],
        place: tuple,
        tint: tuple | None = None,
        facing: str = "up",
        turn: float = 0,
        length: float | None = None,
    ) -> None:
        """A lamp whose size (half its width) and radiance are between two powers of ten.

        Spheres and cubes rest on their place; a rectangle with a (half) `length` is a strip.
        """
        x, y, z = place
        half = 10 ** self.between(*size)
        if kind == "sphere":
            where = f'<point name="center" value="{x:.4f}, {y:.4f}, {z + half:.4f}"/>'
            where += f'<float name="radius" value="{half:.4f}"/>'
        else:
            scale = f'x="{length}" y="{half:.4f}"' if length else f'value="{half:.4f}"'
            turned = f'<rotate x="1" angle="{FACING[facing]}"/>' if FACING[facing] else ""
            turned += f'<rotate z="1" angle="{turn:g}"/>' if turn else ""
            z += half if kind == "cube" else 0
            where = f'<transform name="to_world"><scale {scale}/>{turned}'
            where += f'<translate value="{x:.4f}, {y:.4f}, {z:.4f}"/></transform>'
        colour = 10 ** self.between(*radiance) * np.array(tint or self.tint())
        self.lines.append(
            f'<shape type="{kind}">{where}<ref id="black"/><emitter type="area">'
            f'<rgb name="radiance" value="{colour[0]:.3g}, {colour[1]:.3g}, {colour[2]:.3g}"/>'
            "</emitter></shape>"
        )

    def furnish(self, places: dict[str, tuple[int, float]]) -> None:
        """Sofa, shelf and cupboard at the walls, with the lamps that they hide."""
        for name, (width, origin, front, material) in AT_WALLS.items():
            place = places[name] if name in places else self.find_place(width, front)
            self.places[name] = wall, along = place
            self.mesh(name, material, (*self.at(wall, along, origin), 0), 90 * wall)

        # Behind the sofa a string of fairy lights, under it strips
        wall, along = self.places["sofa"]
        for _ in range(16):
            place = self.at(wall, along + self.between(-0.9, 0.9), self.between(0.015, 0.1))
            place = (*place, self.between(0.03, 0.72))
            self.lamp("sphere", (-2.5, -2.2), (2, 3.5), place)
        for side in (-0.4, 0.4):
            place = (*self.at(wall, along + side, 0.5), 0.118)
            self.lamp("rectangle", (-2.1, -2), (1, 2.5), place, None, "down", 90 * wall, 0.3)

        # Under the boards of the shelf, behind its books, and in the cupboard
        wall, along = self.places["shelf"]
        for k in range(3):
            self.mesh(f"books_{k}", f"book_{k}", (*self.at(wall, along, 0.16), 0), 90 * wall)
        for board in (0.459, 0.859, 1.259, 1.659):
            tint = self.tint()
            for side in (-0.36, -0.12, 0.12, 0.36):
                side += self.between(-0.1, 0.1)
                place = (*self.at(wall, along + side, self.between(0.05, 0.25)), board)
                self.lamp("disk", (-2.5, -1.9), (1.6, 3.3), place, tint, "down")
        wall, along = self.places["cupboard"]
        for board in (0.459, 0.879):
            for side in (-0.28, 0, 0.28):
                place = (*self.at(wall, along + side, self.between(0.06, 0.3)), board)
                self.lamp("disk", (-2.3, -1.6), (1, 3), place, None, "down")
        place = (*self.at(wall, along + 0.2, 0.2), 0.902)
        self.lamp("cube", (-1.6, -1), (0.4, 1.6), place)

    def light(self, is_picture: bool) -> None:
        """The table, with all lamps that have nothing to do with furniture at the walls."""
        table = self.around(self.middle, 0.2)
        turn = 90 * self.places["sofa"][0] + self.between(-9, 9)
        if is_picture:
            table, turn = np.array([6.05, 5.9]), 20
        self.mesh("table", "oak", (*table, 0.015), turn)
        self.mesh("shade", "dark", (*table, 1.83))
        self.lamp("disk", (-1.3, -0.9), (2, 2.7), (*table, 1.87), PLAIN, "down")
        for side in (-0.05, 0.05):
            self.lamp("sphere", (-2.2, -1.7), (2, 3.2), (*(table + side), 1.95), WARM)
        for _ in range(3):
            self.lamp("sphere", (-2.3, -1.8), (1.5, 3), (*self.around(table, 0.25), 0.766), WARM)
        for _ in range(2):
            place = (*self.around(table, 0.2), 0.733)
            self.lamp("disk", (-2.2, -1.5), (1, 2.5), place, None, "down")

        # Strips on a ledge, a garland along the next wall, night lights, a bowl on a pole
        wall, tint = int(4 * self.draw.random()), self.tint()
        if is_picture:
            wall, tint = 1, PLAIN
        self.mesh("ledge", "paint", (*self.at(wall, INSIDE / 2, 0), 2.4), 90 * wall)
        for k in range(5):
            place = (*self.at(wall, INSIDE / 2 + 0.66 * (k - 2), 0.05), 2.42)
            self.lamp("rectangle", (-2.3, -2.1), (1.5, 2.5), place, tint, "up", 90 * wall, 0.3)
        for t in (np.arange(16) + 0.5) / 16:
            place = self.at((wall + 1) % 4, 0.15 + (INSIDE - 0.3) * t, 0.04)
            place = (*place, 2.36 - 0.16 * np.sin(np.pi * (5 * t % 1)))
            self.lamp("sphere", (-2.5, -2), (1.8, 3), place)
        for _ in range(3):
            wall, along = self.find_place(0.2, 0.01)
            place = (*self.at(wall, along, 0.003), 0.25)
            self.lamp("disk", (-1.9, -1.3), (-0.3, 1.2), place, None, "out", 90 * wall)
        corner = np.sign([self.between(-1, 1), self.between(-1, 1)])
        corner = self.middle + 1.7 * (np.array([-1, -1]) if is_picture else corner)
        self.mesh("stand", "dark", (*corner, 0))
        self.lamp("disk", (-1.6, -1.1), (2, 3), (*corner, 1.66), PLAIN)

        # Spots and panels in the ceiling, paper globes under it
        for _ in range(7):
            place = (*self.around(self.middle, 1.6), 2.697)
            self.lamp("disk", (-2, -1.4), (1, 3), place, None, "down")
        place = (*self.around(self.middle, 1.2), 2.695)
        self.lamp("rectangle", (-1, -0.5), (0.4, 1.8), place, None, "down")
        for _ in range(0 if is_picture else 1 + int(self.middle.sum() / ROOM) % 2):
            place = table
            while np.linalg.norm(place - table) < 0.7:
                place = self.around(self.middle, 1.2)
            self.lamp("sphere", (-1.2, -0.53), (-0.3, 1), (*place, 1.9))


def lamps() -> str:
    """A thousand lamps, and the furniture that hides most of them, for a scene file to include."""
    draw = np.random.Generator(np.random.PCG64(11))
    lines = ["<!-- Written by make_assets.py -->", '<scene version="3.0.0">']
    for row in range(ROWS):
        for column in range(COLUMNS):
            room, is_picture = Room(column, row, draw), (column, row) == (1, 1)
            given = {"sofa": (2, 1.15), "shelf": (1, 1.13), "cupboard": (3, 1.3)}
            room.furnish(given if is_picture else {})
            room.light(is_picture)
            lines += room.lines
    return "\n".join([*lines, "</scene>", ""])


# --- maps --------------------------------------------------------------------------------------


def planks() -> Floats:
    """Floorboards, 2 x 2 m at 256 x 256: sixteen boards side by side, each with its own tint."""
    draw = np.random.Generator(np.random.PCG64(3))
    y, x = np.mgrid[0:256, 0:256]
    board = y // 16
    start = draw.integers(0, 256, 16)[board]
    piece = ((x + start) % 256) // 128
    tint = (0.75 + 0.45 * draw.random((16, 2)))[board, piece]
    grain = np.repeat(draw.random((256, 32)), 8, axis=1)
    grain = (np.roll(grain, 3, axis=1) + grain + np.roll(grain, -3, axis=1)) / 3
    seam = (y % 16 == 0) | ((x + start) % 128 == 0)
    value = tint * (0.9 + 0.2 * grain) * np.where(seam, 0.45, 1)
    return value[..., None] * np.array([0.36, 0.2, 0.1])


def painting() -> Floats:
    """Three hills, a sky and a moon, 192 x 128."""
    y, x = np.mgrid[0:128, 0:192]
    u, v = (x + 0.5) / 192, (y + 0.5) / 128
    below, above = np.array([0.75, 0.42, 0.2]), np.array([0.1, 0.22, 0.38])
    sky = below * v[..., None] + above * (1 - v[..., None])
    moon = np.hypot(u - 0.68, (v - 0.3) / 1.5) < 0.085
    image = np.where(moon[..., None], [0.9, 0.8, 0.55], sky)
    hills = [(0.52, 0.09, 5, 0.4, (0.28, 0.22, 0.3)), (0.66, 0.07, 7, 2.2, (0.14, 0.18, 0.2))]
    for base, swing, waves, phase, colour in hills + [(0.8, 0.06, 4, 4.0, (0.05, 0.09, 0.08))]:
        ridge = base + swing * np.sin(waves * u + phase)
        image = np.where((v > ridge)[..., None], colour, image)
    return image[::-1]  # the first row is the lower edge of a rectangle


def checker() -> Floats:
    """Two greys, 64 x 64, eight fields a side."""
    y, x = np.mgrid[0:64, 0:64]
    return np.where(((x // 8 + y // 8) % 2 == 0)[..., None], [0.55, 0.5, 0.44], [0.12, 0.14, 0.17])


def sky(
    colours: tuple, elevation_of_sun: float, u: float, sun: tuple, glow: tuple, sharpness: float
) -> Floats:
    """512 x 256, latitude-longitude: a gradient from horizon to zenith, plain ground, and a sun of
    2 x 2 texels at (u, elevation in degrees) with a glow around it."""
    elevation = np.pi / 2 - np.pi * (np.arange(256) + 0.5) / 256
    up = np.sin(elevation)[:, None, None]
    horizon, zenith, ground = np.array(colours)
    gradient = zenith + (horizon - zenith) * np.exp(-3.5 * np.maximum(up, 0))
    image = np.repeat(np.where(up > 0, gradient, ground), 512, axis=1)
    azimuth = 2 * np.pi * ((np.arange(512) + 0.5) / 512 - u)
    height = np.radians(elevation_of_sun)
    near = np.cos(elevation)[:, None] * np.cos(azimuth) * np.cos(height)
    near = near + np.sin(elevation)[:, None] * np.sin(height)
    image += (np.exp(sharpness * (near - 1)))[..., None] * np.array(glow)
    row, column = int(256 * (90 - elevation_of_sun) / 180), int(512 * u)
    image[row : row + 2, column : column + 2] = sun
    return image


def sunny_sky() -> Floats:
    """The sky of sunny_gloss.xml: its sun stands 39 degrees high.

    Its four texels of 1e4 make an irradiance of 4.7 on a plane that faces it; on the ground they
    give about four times as much as all the rest.
    """
    colours = ((0.5, 0.58, 0.7), (0.09, 0.18, 0.42), (0.33, 0.28, 0.23))
    sun = np.array([1.15, 1.0, 0.8]) * 1e4
    return sky(colours, 39, 0.32, sun, (1.6, 1.3, 0.9), 60)


def clear_sky() -> Floats:
    """The sky of window.xml: a sun in the south-west, 33 degrees high, over dark ground."""
    colours = ((0.65, 0.75, 0.9), (0.2, 0.42, 0.95), (0.1, 0.09, 0.07))
    sun = np.array([1.15, 1.0, 0.8]) * 3e4
    return sky(colours, 33, 0.625, sun, (4, 3.4, 2.6), 60)


def write_exr(path: Path, image: Floats) -> None:
    """Half floats, linear, rounded to a thousandth: repeatable, and smaller."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": np.round(image, 3).astype(np.float16)}) as exr:
        exr.write(str(path))


def main() -> None:
    """Write everything into the folder named on the command line, or `assets/`."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent / "assets")
    folder.mkdir(parents=True, exist_ok=True)
    smooth = pot() | tableware() | plant() | {"knot": torus_knot(2, 3, 0.2, 0.09, 0.05)}
    leaf_and_knob = door()
    flat = furniture() | house() | {"door": leaf_and_knob["door"]}
    flat |= {"gem": icosphere(1), "wall_with_holes": wall_with_holes()}
    smooth["knob"] = leaf_and_knob["knob"]
    flat |= cupboard() | fittings() | window_room()
    for name in ("stand", "curtain"):
        smooth[name] = flat.pop(name)
    for name, mesh in smooth.items():
        write_ply(folder / f"{name}.ply", mesh, smooth=True)
    for name, mesh in flat.items():
        write_ply(folder / f"{name}.ply", mesh)
    maps = {
        "planks": planks(),
        "painting": painting(),
        "checker": checker(),
        "sunny_sky": sunny_sky(),
        "clear_sky": clear_sky(),
    }
    for name, image in maps.items():
        write_exr(folder / f"{name}.exr", image)
    (folder / "lamps.xml").write_text(lamps())


if __name__ == "__main__":
    main()
