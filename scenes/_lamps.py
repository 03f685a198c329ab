"""The thousand lamps of many_lamps.xml, and the furniture that hides most of them."""

from __future__ import annotations

import numpy as np
from _geometry import Floats
from _walls import COLUMNS, INSIDE, ROOM, ROWS, doorways

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

    A place at a wall (0 to 3: north, west, south, east) has two coordinates in metres: along the
    wall, from its left corner as seen from inside, and the distance from the wall.
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
        """A place at a wall that is free of doorways and furniture."""

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
