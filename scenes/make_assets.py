"""Writes every mesh (PLY) and map (EXR) in `scenes/assets/` that the scene files use.

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
    box,
    icosphere,
    join,
    lathe,
    quad,
    rounded,
    torus_knot,
    tube,
    write_ply,
)

# The house of rooms.xml: rooms of 4 x 4 m and 2.7 m, walls 0.14 m thick
COLUMNS, ROWS, ROOM, HEIGHT, WALL = 4, 3, 4.0, 2.7, 0.14
DOOR_HEIGHT = 2.1
WALL_COLOURS = 4


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


# --- the furnaces' walls -----------------------------------------------------------------------


def wall_with_holes() -> Mesh:
    """One face of furnace_lamps.xml: [-1, 1]^2 facing +z, minus the places of its two lamps."""
    xs, ys = [-1, -0.75, -0.625, 0, 0.5, 1], [-1, -0.5, 0, 0.5, 0.625, 1]
    cells = []
    for i in range(5):
        for j in range(5):
            if (i, j) not in {(1, 3), (3, 1)}:
                corner = (xs[i], ys[j], 0)
                cells.append(quad(corner, (xs[i + 1] - xs[i], 0, 0), (0, ys[j + 1] - ys[j], 0)))
    walls = join(*cells)
    return Mesh(walls.positions, walls.faces)


# --- the house of rooms.xml --------------------------------------------------------------------


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


def house() -> dict[str, Mesh]:
    """Walls by colour, floor and ceiling; room (column, row) starts at 4 m times its indices."""
    colours: list[list[Mesh]] = [[] for _ in range(WALL_COLOURS)]
    inside = ROOM - WALL
    for column in range(COLUMNS):
        for row in range(ROWS):
            # The four neighbours: north (+y), west (-x), south (-y), east (+x)
            holes = [
                opening(column, row, 1) if row + 1 < ROWS else None,
                opening(column - 1, row, 0) if column > 0 else None,
                opening(column, row - 1, 1) if row > 0 else None,
                opening(column, row, 0) if column + 1 < COLUMNS else None,
            ]
            for turn, hole in enumerate(holes):
                # Seen from inside, a doorway's coordinate runs backwards on the west... south side
                if hole is not None:
                    start, stop = hole[0] - WALL / 2, hole[1] - WALL / 2
                    hole = (start, stop) if turn in (0, 1) else (inside - stop, inside - start)
                for part in wall_side(inside, hole):
                    centred = part.moved((-inside / 2, inside / 2, 0)).turned(90 * turn)
                    at = ((column + 0.5) * ROOM, (row + 0.5) * ROOM, 0)
                    colours[(column + 2 * row) % WALL_COLOURS].append(centred.moved(at))
    width, depth = COLUMNS * ROOM, ROWS * ROOM
    meshes = {f"house_{k}": join(*parts) for k, parts in enumerate(colours)}
    for mesh in meshes.values():
        mesh.uv = None
    meshes["house_floor"] = quad((0, 0, 0), (width, 0, 0), (0, depth, 0), 0.5)
    meshes["house_ceiling"] = quad((0, depth, HEIGHT), (width, 0, 0), (0, -depth, 0))
    return meshes


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


def sunny_sky() -> Floats:
    """512 x 256, latitude-longitude: a gradient sky, warm ground, and a sun of 2 x 2 texels.

    The sun stands 39 degrees high at u = 0.32; its four texels of 1e4 make an irradiance of 4.7
    on a plane that faces it; on the ground they give about four times as much as all the rest.
    """
    elevation = np.pi / 2 - np.pi * (np.arange(256) + 0.5) / 256
    up = np.sin(elevation)[:, None, None]
    horizon, zenith, ground = np.array([[0.5, 0.58, 0.7], [0.09, 0.18, 0.42], [0.33, 0.28, 0.23]])
    sky = zenith + (horizon - zenith) * np.exp(-3.5 * np.maximum(up, 0))
    image = np.repeat(np.where(up > 0, sky, ground), 512, axis=1)
    azimuth = 2 * np.pi * ((np.arange(512) + 0.5) / 512 - 0.32)
    near = np.cos(elevation)[:, None] * np.cos(azimuth) * np.cos(np.radians(39))
    near = near + np.sin(elevation)[:, None] * np.sin(np.radians(39))
    image += (np.exp(60 * (near - 1)))[..., None] * np.array([1.6, 1.3, 0.9])  # the glow around it
    row, column = int(256 * (90 - 39) / 180), int(512 * 0.32)
    image[row : row + 2, column : column + 2] = np.array([1.15, 1.0, 0.8]) * 1e4
    return image


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
    for name, mesh in smooth.items():
        write_ply(folder / f"{name}.ply", mesh, smooth=True)
    for name, mesh in flat.items():
        write_ply(folder / f"{name}.ply", mesh)
    maps = {
        "planks": planks(),
        "painting": painting(),
        "checker": checker(),
        "sunny_sky": sunny_sky(),
    }
    for name, image in maps.items():
        write_exr(folder / f"{name}.exr", image)


if __name__ == "__main__":
    main()
