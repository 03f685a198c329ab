"""The walls of the scenes' rooms, with their doorways and windows.

The house of rooms.xml and many_lamps.xml, the room of window.xml, one face of a furnace, the wall
of keyhole.xml.
"""

from __future__ import annotations

import numpy as np
from _geometry import Floats, Mesh, block, box, join, perforated, quad

# The house of rooms.xml and many_lamps.xml: rooms of 4 x 4 m and 2.7 m, walls 0.14 m thick
COLUMNS, ROWS, ROOM, HEIGHT, WALL = 4, 3, 4.0, 2.7, 0.14
DOOR_HEIGHT = 2.1
WALL_COLOURS = 4
INSIDE = ROOM - WALL

# The room of window.xml: its size, the thickness of its walls, and the windows in its south wall
WIDTH, DEPTH, TALL, THICK = 5.2, 4.0, 2.7, 0.24
WINDOWS, SILL, LINTEL = ((0.35, 2.05), (2.6, 4.3)), 0.6, 2.45


# ---- The furnaces' walls ----


def wall_with_holes() -> Mesh:
    """One face of furnace_lamps.xml: [-1, 1]^2 facing +z, minus the places of its two lamps."""
    xs, ys = [-1, -0.75, -0.625, 0, 0.5, 1], [-1, -0.5, 0, 0.5, 0.625, 1]
    return perforated(xs, ys, {(1, 3), (3, 1)})


# ---- The house of rooms.xml and many_lamps.xml ----


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


# ---- The room of window.xml ----


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


# ---- The wall of keyhole.xml ----


def keyhole_outline() -> Floats:
    """A circle above a foot, 28 cm high, counter-clockwise; the origin sees all of it."""
    neck = np.radians(-55)  # where the foot leaves the arc
    angles = np.linspace(neck, np.pi - neck, 40)
    arc = 0.085 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.concatenate([[(-0.07, -0.2), (0.07, -0.2)], arc])


def around_keyhole(outer: Floats, z: float) -> Mesh:
    """The plane at height z, facing +z, between the keyhole and an outline with as many points."""
    inner = keyhole_outline()
    count = len(inner)
    points = np.concatenate([inner, outer])
    positions = np.column_stack([points, np.full(2 * count, z)])
    i = np.arange(count)
    j = (i + 1) % count
    faces = np.concatenate([np.stack([i, i + count, j + count], 1), np.stack([i, j + count, j], 1)])
    return Mesh(positions, faces)


def prism_shell(outline: Floats, low: float, high: float) -> Mesh:
    """The side of a prism, facing outwards if the outline is counter-clockwise."""
    count = len(outline)
    rings = [np.column_stack([outline, np.full(count, z)]) for z in (low, high)]
    i = np.arange(count)
    j = (i + 1) % count
    faces = np.concatenate([np.stack([i, j, j + count], 1), np.stack([i, j + count, i + count], 1)])
    return Mesh(np.concatenate(rings), faces)


def keyhole() -> dict[str, Mesh]:
    """A wall of 6 x 3 m, 0.1 m thick, and a plate of 2 mm on its side z > 0; the origin is in the
    middle of the keyhole."""
    hole = keyhole_outline()
    reach = np.array([3.0, 1.5]) / np.maximum(np.abs(hole), 1e-9)
    far = hole * reach.min(axis=1, keepdims=True)
    # The two points nearest to each corner of the wall would cut it off
    for corner in np.array([(x, y) for x in (-3.0, 3.0) for y in (-1.5, 1.5)]):
        far[np.argmin(np.linalg.norm(far - corner, axis=1))] = corner
    front, back = around_keyhole(far, 0.05), around_keyhole(far, -0.05)
    back = Mesh(back.positions, back.faces[:, ::-1])
    reveal = prism_shell(hole[::-1], -0.05, 0.05)
    angle = np.arctan2(hole[:, 1] + 0.05, hole[:, 0])
    oval = np.stack([0.14 * np.cos(angle), 0.23 * np.sin(angle) - 0.05], axis=1)
    plate = join(around_keyhole(oval, 0.054), prism_shell(oval, 0.05, 0.054))
    plate = join(plate, prism_shell(hole[::-1], 0.05, 0.054))
    return {"keyhole_wall": join(front, back, reveal), "keyhole_plate": plate}
