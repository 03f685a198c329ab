"""The objects of the scenes: tableware, a plant, furniture, a school desk, a door."""

from __future__ import annotations

import numpy as np
from _geometry import Mesh, block, box, convex, join, lathe, rounded, tube


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
    """The other surfaces of revolution."""
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
    # A table lamp: its foot with the socket, and a shade with rounded rims, to be hung at its top
    foot = [(0, 0), (0.085, 0), (0.09, 0.012), (0.03, 0.03), (0.045, 0.08), (0.055, 0.14)]
    foot += [(0.03, 0.21), (0.012, 0.235), (0.016, 0.245), (0.016, 0.29), (0, 0.29)]
    hood = [(0.16, 0), (0.0905, 0.2), (0.09, 0.2015), (0.0895, 0.2), (0.158, 0), (0.159, -0.0015)]
    return {
        "vase": lathe(rounded(vase)),
        "bowl": lathe(rounded(bowl), 48),
        "glass": lathe(rounded(glass), 48),
        "shade": lathe(shade),
        "dish": lathe(rounded(dish)),
        "planter": lathe(rounded(planter, 1)),
        "lamp_foot": lathe(rounded(foot), 48),
        "lamp_shade": lathe([*hood, hood[0]], 64),
    }


def ring() -> dict[str, Mesh]:
    """A ring of outer radius 1 around the origin, 0.8 high, its edges rounded; it stands on z = 0.

    The many vertices along its inside keep the interpolated normals there exactly horizontal.
    """
    inside, outside, height, edge = 0.88, 1.0, 0.8, 0.035
    corner = np.radians(np.linspace(0, 90, 6))
    quarter = edge * np.stack([np.sin(corner), 1 - np.cos(corner)], axis=1)
    middle = (inside + outside) / 2
    bottom = [(middle, 0), *((outside - edge, 0) + quarter)]
    top = [(r, height - z) for r, z in bottom[::-1]]
    outer = [*bottom, (outside, height / 2), *top]
    inner = [(2 * middle - r, z) for r, z in outer[::-1]]
    flat = [(inside, z) for z in (height - 2 * edge, height / 2, 2 * edge)]
    half = len(inner) // 2
    profile = [*outer, *inner[1:half], *flat, *inner[half + 1 : -1], outer[0]]
    return {"ring": lathe(profile, 192)}


def prism() -> dict[str, Mesh]:
    """A prism of 60 degrees around the origin, 0.4 m wide, 0.5 m high; its base faces -y."""
    angles = np.radians([90, 210, 330])
    corners = 0.4 / np.sqrt(3) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = np.array([(x, y, z) for z in (-0.25, 0.25) for x, y in corners])
    loops = [[0, 1, 2], [3, 4, 5], [0, 1, 4, 3], [1, 2, 5, 4], [2, 0, 3, 5]]
    return {"prism": convex(points, loops)}


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


def school() -> dict[str, Mesh]:
    """A desk with an open compartment under its top, its frame, and a lamp's fitting: a square tube
    of 12 cm, open below, whose ceiling is at z = 0. The pupil sits at +y."""
    top = [box((-0.6, -0.25, 0.73), (0.6, 0.25, 0.76), 0.006)]
    top.append(box((-0.56, -0.22, 0.6), (0.56, 0.22, 0.61), 0.002))
    top.append(box((-0.56, -0.22, 0.61), (0.56, -0.21, 0.73), 0.002))
    top += [box((x - 0.01, -0.21, 0.61), (x + 0.01, 0.22, 0.73), 0.002) for x in (-0.55, 0, 0.55)]
    frame = []
    for x in (-0.54, 0.54):
        frame += [box((x - 0.02, y - 0.02, 0), (x + 0.02, y + 0.02, 0.6)) for y in (-0.19, 0.19)]
        frame.append(box((x - 0.015, -0.17, 0.12), (x + 0.015, 0.17, 0.15)))
    frame.append(box((-0.52, -0.2, 0.35), (0.52, -0.18, 0.38)))
    sides = [box((x - 0.003, -0.06, -0.1), (x + 0.003, 0.06, 0), 0.001) for x in (-0.057, 0.057)]
    sides += [side.turned(90) for side in sides]
    return {"desk": join(*top), "desk_frame": join(*frame), "fitting": join(*sides)}


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
    """Objects that hide lamps of many_lamps.xml: a ledge along a wall, and a bowl on a pole."""
    ledge = [block((-1.7, -0.12, 0), (1.7, 0, 0.015))]
    ledge.append(block((-1.7, -0.12, 0.015), (1.7, -0.105, 0.07)))
    stand = [(0, 0), (0.14, 0), (0.14, 0.012), (0.014, 0.02), (0.014, 1.6), (0.15, 1.72)]
    stand += [(0.147, 1.722), (0.01, 1.61), (0, 1.61)]
    return {"ledge": join(*ledge), "stand": lathe(stand, 24)}
