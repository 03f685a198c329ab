"""What a sample takes with sets of techniques, in units of the time of one of ``path``: measured,
and in brackets as the trial of ``auto`` predicts it.

    python benchmarks/technique_times.py scenes/corridor.xml scenes/keyhole.xml …

The constants of ``mitsuba_ext/estimators/light_paths/choice/light_paths.py``, and ``SEGMENT`` and
``SHADOW`` of ``mitsuba_ext/planning/evidence.py``, were fitted to what this prints. The machine
must be idle.
"""

from __future__ import annotations

import statistics
from pathlib import Path

import click

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before mitsuba)

import mitsuba as mi  # isort: skip

from mitsuba_ext.estimators.light_paths.choice.candidates import Candidate  # isort: skip
from mitsuba_ext.estimators.light_paths.choice.light_paths import LightPathTrial  # isort: skip
from mitsuba_ext.inputs.scenes import load_scene, scene_name  # isort: skip

#: The sets of techniques; those that merge are measured where the trial can merge.
SETS = (
    Candidate(1 / 16, 0), Candidate(1 / 16, 1), Candidate(1 / 16, 4), Candidate(1 / 4, 1),
    Candidate(1.0, 0), Candidate(1.0, 1), Candidate(1.0, 4), Candidate(1.0, 0, True),
    Candidate(1.0, 1, True),
)  # fmt: skip

#: Longest paths, and samples per pixel of the render whose trial predicts.
_MAX_DEPTH, _SPP = 6, 64


def predicted_times(scene: mi.Scene) -> dict[Candidate, float]:
    """What the trial of a render predicts for each of its candidates."""
    trials, choose = [], LightPathTrial.choose
    LightPathTrial.choose = lambda trial, rival: trials.append(trial) or choose(trial, rival)
    try:
        auto = mi.load_dict({"type": "auto", "max_depth": _MAX_DEPTH})
        mi.render(scene, integrator=auto, spp=_SPP)
    finally:
        LightPathTrial.choose = choose
    return {c: float(x) for trial in trials for c, x in zip(trial.candidates, trial.costs)}


def integrator_of(techniques: Candidate) -> mi.Integrator:
    """The integrator that has these techniques, and all lights by chance as ``path``."""
    return mi.load_dict({
        "type": "vcm" if techniques.merges else "bdpt", "max_depth": _MAX_DEPTH,
        "light_paths": techniques.light_paths, "connections": techniques.connections,
    })  # fmt: skip


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--spp", default=24, show_default=True)
@click.option("--rounds", default=3, show_default=True, help="The first one compiles.")
def main(files: tuple[Path, ...], spp: int, rounds: int) -> None:
    """Measures on the scenes FILES, 320x180."""
    mi.set_variant("llvm_ad_rgb")
    for file in files:
        scene = load_scene(file, (320, 180)).scene
        predicted = predicted_times(scene)
        path = mi.load_dict({"type": "composed_path", "max_depth": _MAX_DEPTH})
        made = {c: integrator_of(c) for c in SETS if c in predicted}
        times = {c: [] for c in (None, *made)}
        for seed in range(rounds):
            for techniques, integrator in ((None, path), *made.items()):
                mi.render(scene, integrator=integrator, seed=seed, spp=spp)
                times[techniques].append(integrator.statistics.seconds)
        medians = {c: statistics.median(some[1:]) for c, some in times.items()}
        for techniques in made:
            measured = medians[techniques] / medians[None]
            print(
                f"{scene_name(file)}, {techniques}: {measured:.2f} ({predicted[techniques]:.2f})",
                flush=True,
            )


if __name__ == "__main__":
    main()
