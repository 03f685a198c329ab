"""Records what each integrator renders, to prove that a change of the code changes no image.

    python benchmarks/image_record.py write before.json          # in the version to compare with
    python benchmarks/image_record.py write after.json           # in the changed one
    python benchmarks/image_record.py compare before.json after.json

Each integrator renders each scene with each seed: hash and mean of the image, counts of rays, what
was learned and with what effect, and the number of kernels. Dr.Jit uses one thread: sums then have
one order, and equal code gives equal bits. Shapes are not merged, which would order lights at
random. About 25 minutes of one core; ``--scene`` and ``--integrator`` choose some.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import click

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)

SCENES = Path(__file__).resolve().parents[1] / "scenes"

#: Scenes, each with what the others lack.
NAMES = {
    "cornell_box": "diffuse surfaces, one lamp",
    "rooms": "many lamps, most of them hidden",
    "mirrors_and_glass": "smooth and rough metal and glass",
    "sunny_gloss": "an environment map with a sun",
    "fog": "a medium with a grid",
    "six_balls": "moving shapes",
}

#: The integrators, those that nest others around the simplest one.
INTEGRATORS = (
    "adaptive:nested=[composed_path]", "auto", "auto_path", "bdpt", "composed_path",
    "composed_path:directions=guided,next_event=contribution,connections=2",
    "composed_path:next_event=spatial,shadow_test=visibility_roulette", "composed_prb", "erpt",
    "erpt:mutations=path", "instant_radiosity", "irradiance_cache", "light_tracer", "mlt", "neepp",
    "photon_map", "pss_guided", "pssmlt", "reweighted_direct", "sppm", "swarm_path", "two_stage",
    "variance:nested=[neepp]", "vcm",
)  # fmt: skip

#: Enough samples for ``auto`` to learn, and to try light paths.
SIZE, SPP, SEEDS = (96, 54), 104, (1, 2)


def record(scene_name: str, specification: str, seed: int) -> dict[str, Any]:
    """What one render gives; how it is refused, if it is."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    from mitsuba_ext.inputs.specifications import make_named

    width, height = SIZE
    dr.set_thread_count(2)  # with one thread, Mitsuba waits for ever when it reads an EXR file
    scene = mi.load_file(
        str(SCENES / f"{scene_name}.xml"), width=width, height=height, optimize=False
    )
    dr.set_thread_count(1)
    launched = dr.detail.launch_stats()[0]
    try:
        integrator = make_named(specification, {"max_depth": 6}).integrator
        image = np.array(mi.render(scene, integrator=integrator, spp=SPP, seed=seed))
    except (NotImplementedError, RuntimeError, ValueError) as error:
        return {"refused": str(error)}
    statistics = getattr(integrator, "statistics", None)
    return {
        "image": hashlib.sha256(np.ascontiguousarray(image, np.float32).tobytes()).hexdigest(),
        "mean": float(image[..., :3].mean(dtype=np.float64)),
        "kernels": dr.detail.launch_stats()[0] - launched,
        **({} if statistics is None else {
            "rays": statistics.rays, "learned": statistics.learned, "effects": statistics.effects,
        }),
    }  # fmt: skip


@click.group()
def main() -> None:
    """Records images, and compares records."""


@main.command()
@click.argument("file", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--scene", "scenes", multiple=True, default=tuple(NAMES))
@click.option("--integrator", "integrators", multiple=True, default=INTEGRATORS)
def write(file: Path, scenes: tuple[str, ...], integrators: tuple[str, ...]) -> None:
    """Renders everything that FILE does not hold yet, a process for each scene and integrator."""
    found = json.loads(file.read_text()) if file.exists() else {}
    for scene in scenes:
        for integrator in integrators:
            if f"{scene} {integrator}" in found:
                continue
            command = [sys.executable, __file__, "one", scene, integrator]
            done = subprocess.run(command, capture_output=True, text=True)
            # Mitsuba's log, which may colour the line, is there as well
            _log, is_found, text = done.stdout.rpartition('[{"')
            result = json.loads(is_found + text) if is_found else [{"died": done.stderr[-500:]}]
            found[f"{scene} {integrator}"] = result
            file.write_text(json.dumps(found, indent=1))
            print(scene, integrator, result[0].get("mean", result[0]), flush=True)


@main.command(hidden=True)
@click.argument("scene")
@click.argument("integrator")
def one(scene: str, integrator: str) -> None:
    """Prints the records of all seeds."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    print(json.dumps([record(scene, integrator, seed) for seed in SEEDS]))


@main.command()
@click.argument("before", type=click.Path(exists=True, path_type=Path))
@click.argument("after", type=click.Path(exists=True, path_type=Path))
def compare(before: Path, after: Path) -> None:
    """Prints what differs, and exits with 1 if anything does."""
    old, new = (json.loads(file.read_text()) for file in (before, after))
    differ = 0
    for key in [*old, *(key for key in new if key not in old)]:
        if key not in old or key not in new:
            print(f"{key}: only in {before if key in old else after}")
            differ += 1
            continue
        for seed, a, b in zip(SEEDS, old[key], new[key]):
            names = [name for name in {**a, **b} if a.get(name) != b.get(name)]
            differ += bool(names)
            # A hash says less than the mean
            for name in [name for name in names if name != "image"] or names:
                print(f"{key}, seed {seed}: {name}: {a.get(name)} -> {b.get(name)}")
    print(f"{differ} of {sum(map(len, old.values()))} differ")
    sys.exit(differ > 0)


if __name__ == "__main__":
    main()
