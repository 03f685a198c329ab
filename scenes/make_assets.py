"""Writes every mesh (PLY) and map (EXR) in `scenes/assets/` that the scene files use, and the
thousand lamps of many_lamps.xml.

    python scenes/make_assets.py [folder]

Needs numpy and the OpenEXR package. A second run writes the same bytes.
"""

from __future__ import annotations

import sys
from pathlib import Path

from _geometry import icosphere, torus_knot, write_ply
from _glassware import globe, tumbler
from _lamps import lamps
from _maps import checker, clear_sky, dunes, hall, painting, planks, sunny_sky, tiles, write_exr
from _pool import pool, water
from _things import cupboard, door, fittings, furniture, plant, pot, prism, ring, school, tableware
from _walls import house, keyhole, wall_with_holes, window_room


def main() -> None:
    """Write everything into the folder named on the command line, or `assets/`."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent / "assets")
    folder.mkdir(parents=True, exist_ok=True)
    smooth = pot() | tableware() | plant() | {"knot": torus_knot(2, 3, 0.2, 0.09, 0.05)}
    leaf_and_knob = door()
    flat = furniture() | house() | {"door": leaf_and_knob["door"]}
    flat |= {"gem": icosphere(1), "wall_with_holes": wall_with_holes()}
    smooth |= ring() | {"knob": leaf_and_knob["knob"], "water": water()}
    smooth |= tumbler() | {"globe": globe()}
    flat |= cupboard() | fittings() | window_room() | prism() | school() | pool() | keyhole()
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
        "tiles": tiles(),
        "sunny_sky": sunny_sky(),
        "clear_sky": clear_sky(),
        "hall": hall(),
        "dunes": dunes(),
    }
    for name, image in maps.items():
        write_exr(folder / f"{name}.exr", image)
    (folder / "lamps.xml").write_text(lamps())


if __name__ == "__main__":
    main()
