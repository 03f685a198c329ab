"""What channels of light path expressions cost: CPU time relative to a render without them.

    python benchmarks/channel_costs.py cornell_box /work/shared/scenes/kitchen/scene.xml
    python benchmarks/channel_costs.py --masks cornell_box

Renders of all lists of channels take turns. The table has the ratio of the shortest times.
"""

from __future__ import annotations

import time

import click
from equal_samples import load, title

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)
from mitsuba_ext.scene.aovs import PASSES

import mitsuba as mi  # isort: skip

#: The lists, by what they hold.
LISTS = {
    "none": "",
    "light groups": "groups:light_groups",
    "one pass": "caustics:caustics",
    "eight passes": ",".join(f"{name}:{name}" for name in PASSES),
    "depth": "depth:depth",
}

#: Masks need a scene whose meshes are not merged, which is slower.
MASKS = {"none": "", "masks": "objects:cryptomatte_object"}


@click.command()
@click.option("--spp", default=64)
@click.option("--repeats", default=5)
@click.option("--masks", is_flag=True, help="Measure masks, in scenes that are not optimized.")
@click.argument("scenes", nargs=-1, required=True)
def main(scenes: tuple[str, ...], spp: int, repeats: int, masks: bool) -> None:
    """Prints a row for each of SCENES."""
    mi.set_variant("llvm_ad_rgb")
    lists = MASKS if masks else LISTS
    print("| scene |", " | ".join(lists), "|")
    print("|---" * (len(lists) + 1) + "|")
    for name in scenes:
        scene = load(name, (160, 90), optimize=not masks)
        seconds = {}
        for repeat in range(repeats + 1):
            for kind, aovs in lists.items():
                chosen = {"aovs": aovs} if aovs else {}
                integrator = mi.load_dict({"type": "composed_path", "max_depth": 6, **chosen})
                begin = time.process_time()
                integrator.render(scene, spp=spp, seed=repeat)
                if repeat > 0:  # the first one compiles
                    seconds.setdefault(kind, []).append(time.process_time() - begin)
        ratios = [min(seconds[kind]) / min(seconds["none"]) for kind in lists]
        print(f"| {title(name)} |", " | ".join(f"{ratio:.2f}" for ratio in ratios), "|")


if __name__ == "__main__":
    main()
