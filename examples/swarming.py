"""Measures maps of samples that pixels share, as Table 9.2 of Cline's dissertation does:
``.venv/bin/python examples/swarming.py`` (several minutes).

For each map: σ/μ (root mean squared error over the mean of the image) of plain paths, of paths with
a ``multijitter`` sampler, of the technique of ours that takes the same decision, and of
``swarm_path`` with all maps, at equal numbers of samples, with seconds.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, NamedTuple

import click

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)

import mitsuba as mi  # isort: skip
import numpy as np

SCENES = Path(__file__).parents[1] / "scenes"


class Case(NamedTuple):
    """A row of the table.

    Attributes:
        scene, depth, spp: What is rendered.
        rival: The technique of ours that takes the same decision.
        gain: By what factor σ/μ falls in the source.
        reference_spp: Samples of the reference.
    """

    scene: str
    depth: int
    spp: int
    rival: dict[str, Any]
    gain: float
    reference_spp: int = 2048


def _sets(kind: str) -> dict[str, Any]:
    return {"type": f"reweighted_{kind}", "nested": {"type": "composed_path"}}


CASES = {
    "time": Case("six_balls", 2, 16, _sets("time"), 5.0, 4096),
    "lens": Case("colour_wheel", 2, 32, _sets("lens"), 5.9, 8192),
    "direction": Case("box_with_hole", 4, 64, {"type": "pss_guided"}, 2.5, 2048),
    "light selection": Case("spotlights", 3, 6, {"type": "neepp"}, 2.9),
    "bifurcation": Case("panes", 8, 32, {"type": "pss_guided"}, 4.3),
    "point on light": Case("three_balls", 3, 32, {"type": "neepp"}, 2.6),
}  # fmt: skip


def _rendered(
    scene: mi.Scene, integrator: mi.Integrator, spp: int, seed: int
) -> tuple[np.ndarray, float]:
    begin = time.perf_counter()
    image = np.array(mi.render(scene, integrator=integrator, seed=seed, spp=spp))
    return image, time.perf_counter() - begin


def _integrator(parameters: dict[str, Any], depth: int) -> mi.Integrator:
    if "nested" in parameters:
        return mi.load_dict({**parameters, "nested": {**parameters["nested"], "max_depth": depth}})
    return mi.load_dict({**parameters, "max_depth": depth})


@click.command()
@click.argument("names", nargs=-1, type=click.Choice(list(CASES)))
@click.option("--width", default=320, show_default=True)
@click.option("--seeds", default=3, show_default=True)
def main(names: tuple[str, ...], width: int, seeds: int) -> None:
    """Measures the maps NAMES (all, if none is given)."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    for name in names or CASES:
        case = CASES[name]
        file = str(SCENES / f"{case.scene}.xml")
        options = {"width": width, "height": width * 9 // 16}
        scene = mi.load_file(file, **options)
        swarm = _integrator({"type": "swarm_path"}, case.depth)
        reference, _ = _rendered(scene, swarm, case.reference_spp, 999)
        kinds = {
            "path": ({"type": "composed_path"}, "independent"),
            "multijitter": ({"type": "composed_path"}, "multijitter"),
            case.rival["type"]: (case.rival, "independent"),
            "swarm_path": ({"type": "swarm_path"}, "independent"),
        }
        results = {}
        for kind, (parameters, sampler) in kinds.items():
            integrator = swarm if kind == "swarm_path" else _integrator(parameters, case.depth)
            target = scene if sampler == "independent" else _resampled(file, options, sampler)
            runs = [
                _rendered(target, integrator, case.spp, 7919 * seed + 1) for seed in range(seeds)
            ]
            squares = [np.square(image - reference).mean() for image, _ in runs]
            # The first run compiles
            seconds = min(t for _, t in runs)
            results[kind] = np.sqrt(np.mean(squares)) / reference.mean(), seconds
        error, seconds = results["path"]
        print(f"{name} ({case.scene}, {case.spp} samples; the source: {case.gain})")
        for kind, (own, own_seconds) in results.items():
            equal_time = error / own * np.sqrt(seconds / own_seconds)
            print(
                f"  {kind}: σ/μ {own:.3f}, {own_seconds:.2f} s, gain {error / own:.2f} at equal "
                f"samples, {equal_time:.2f} at equal time",
                flush=True,
            )
        print(f"  {swarm.statistics.learned}", flush=True)


def _resampled(file: str, options: dict[str, Any], sampler: str) -> mi.Scene:
    """The scene with another sampler."""
    text = Path(file).read_text(encoding="utf-8").replace('type="independent"', f'type="{sampler}"')
    copy = Path(file).with_name(f".{Path(file).stem}_{sampler}.xml")
    copy.write_text(text, encoding="utf-8")
    try:
        return mi.load_file(str(copy), **options)
    finally:
        copy.unlink()


if __name__ == "__main__":
    main()
