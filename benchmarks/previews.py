"""Renders the pictures of scenes/README.md (40 minutes): ``python benchmarks/previews.py``."""

from __future__ import annotations

from pathlib import Path

import click

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)

import mitsuba as mi  # isort: skip

SCENES = Path(__file__).parents[1] / "scenes"

#: Samples per pixel for a clean picture of each scene.
PICTURES = {
    "door_ajar": 2048,
    "rooms": 2048,
    "cornell_box": 512,
    "open": 256,
    "mirrors_and_glass": 2048,
    "sunny_gloss": 1024,
    "many_lamps": 2048,
    "window": 2048,
    "box_with_hole": 512,
    "colonnade": 192,
    "three_balls": 192,
    "defocus": 2048,
    "fast_balls": 512,
    "fan": 512,
    "lantern": 2048,
    "six_balls": 256,
    "colour_wheel": 512,
    "spotlights": 128,
    "panes": 256,
    "peppers_ghost": 128,
    "bounce_card": 128,
    "burning_glass": 256,
    "showroom": 256,
    "discharge_lamps": 512,
    "paperweight": 512,
    "flint": 1024,
    "caustic": 256,
    "glass_lamp": 96,
    "ring": 768,
    "pool": 512,
    "water_glass": 512,
    "mirrored_lamp": 512,
    "keyhole": 512,
    "shaded_lamp": 192,
    "corridor": 64,
    "night_classroom": 128,
    "near_lights": 256,
    "fog": 1024,
    "volume_caustic": 256,
    "dunes": 256,
}

#: Scenes rendered by light paths or chains, or in which nothing is learned of visibility; all
#: others have "neepp".
INTEGRATORS = {
    **dict.fromkeys(
        [
            "caustic",
            "glass_lamp",
            "corridor",
            "ring",
            "shaded_lamp",
            "burning_glass",
            "bounce_card",
        ],
        "bdpt",
    ),
    **dict.fromkeys(["pool", "keyhole"], "erpt"),
    **dict.fromkeys(["water_glass", "mirrored_lamp"], "vcm"),
    "volume_caustic": "sppm",
    **dict.fromkeys(
        [
            "six_balls",
            "colour_wheel",
            "spotlights",
            "panes",
            "peppers_ghost",
            "showroom",
            "discharge_lamps",
            "paperweight",
        ],
        "swarm_path",
    ),
}

#: Scenes that are not 16 : 9.
WIDTHS = {"cornell_box": 216, "caustic": 240, "glass_lamp": 240, "ring": 240, "shaded_lamp": 240}

#: Scenes that need a spectral variant.
SPECTRAL = {"flint", "discharge_lamps"}


@click.command()
@click.argument("names", nargs=-1)
def main(names: tuple[str, ...]) -> None:
    """Writes scenes/previews/NAME.png for the scenes NAMES (all, if none is given), 180 pixels
    high."""
    folder = SCENES / "previews"
    folder.mkdir(exist_ok=True)
    for name in names or PICTURES:
        mi.set_variant("llvm_ad_spectral" if name in SPECTRAL else "llvm_ad_rgb")
        spp = PICTURES[name]
        width, integrator = WIDTHS.get(name, 320), INTEGRATORS.get(name, "neepp")
        scene = mi.load_file(
            str(SCENES / f"{name}.xml"), width=width, height=180, integrator=integrator
        )
        mi.util.write_bitmap(str(folder / f"{name}.png"), mi.render(scene, spp=spp))
        statistics = scene.integrator().statistics
        print(f"{name}: {spp} spp, {statistics.seconds:.0f} s, {statistics.learned}", flush=True)
    mi.Thread.wait_for_tasks()


if __name__ == "__main__":
    main()
