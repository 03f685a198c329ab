"""Measures one kind of map alone, and what maps that know everything would gain:
``.venv/bin/python benchmarks/swarm_limits.py six_balls time_map --depth 2 --spp 16 --edges 1,2,4``.

The gain is the standard deviation between four seeds of plain paths, divided by the one of
``swarm_path`` with this map only, at equal samples and at equal CPU time. For each of ``--edges``,
maps for tiles of this width in pixels are learned from 512 samples per pixel, saved, and used in
renders that learn nothing.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import click
import numpy as np
from equal_samples import SCENES, render_in_turns

import mitsuba as mi  # isort: skip

MAPS = ("time_map", "lens_map", "distance_map", "light_map", "lobe_map", "direction_map")
SEEDS, ORACLE_SPP = 4, 512


@click.command()
@click.argument("scene_name")
@click.argument("names", nargs=-1, type=click.Choice(MAPS))
@click.option("--depth", default=6, show_default=True)
@click.option("--spp", default=32, show_default=True)
@click.option("--width", default=320, show_default=True)
@click.option("--edges", default="", help="Edges of tiles in pixels, with commas.")
def main(
    scene_name: str, names: tuple[str, ...], depth: int, spp: int, width: int, edges: str
) -> None:
    """Measures the maps NAMES together in the scene SCENE_NAME."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    file = str(SCENES / f"{scene_name}.xml")
    scene = mi.load_file(file, width=width, height=width * 9 // 16)

    def swarm(**parameters) -> mi.Integrator:
        wanted = {name: name in names for name in MAPS}
        return mi.load_dict({"type": "swarm_path", "max_depth": depth, **wanted, **parameters})

    def measured(integrator: mi.Integrator) -> tuple[float, float]:
        found = render_in_turns({"": (scene, integrator, spp)}, SEEDS)[""]
        return float(np.sqrt(found.variance.mean())), found.time

    error, seconds = measured(mi.load_dict({"type": "composed_path", "max_depth": depth}))

    def show(what: str, integrator: mi.Integrator) -> None:
        own, own_seconds = measured(integrator)
        gain = error / own
        at_equal_time = gain * (seconds / own_seconds) ** 0.5
        print(
            f"{what}: gain {gain:.2f}, at equal CPU time {at_equal_time:.2f}"
            f" ({own_seconds:.2f} s, plain {seconds:.2f} s); {integrator.statistics.learned}",
            flush=True,
        )

    show("learned", swarm())
    from mitsuba_ext.techniques.swarming import map_learner

    for edge in filter(None, edges.split(",")):
        map_learner.tile_edge = lambda *_, edge=int(edge): edge
        with tempfile.TemporaryDirectory() as folder:
            path = str(Path(folder) / "maps.npz")
            teacher = swarm(save_learned=path, pilot_spp=ORACLE_SPP, always_use=True)
            mi.render(scene, integrator=teacher, seed=77, spp=2 * ORACLE_SPP)
            show(f"known, {edge} pixels", swarm(load_learned=path, always_use=True))


if __name__ == "__main__":
    main()
