"""What learned decisions cost: the time of a sample with a light map and with guided directions, in
units of that of ``path``, and for each event in units of a ray.

    python benchmarks/decision_costs.py scenes/rooms.xml …

The constants of guided directions in ``mitsuba_ext/planning/evidence.py`` are medians of what this
prints.
"""

from __future__ import annotations

import statistics
from pathlib import Path

import click

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before mitsuba)

import mitsuba as mi  # isort: skip

from mitsuba_ext.planning import verdicts  # isort: skip
from mitsuba_ext.rendering.request import Request  # isort: skip

#: Both learned decisions are kept, whatever they are worth.
_GUIDED = {"type": "guided_directions", "always_guide": True}
INTEGRATORS = {
    "path": {},
    "lights": {"next_event": "contribution"},
    "guided": {"directions": {**_GUIDED, "bounces": 1}},
    "guided, 3 bounces": {"directions": {**_GUIDED, "bounces": 3}},
}


def _rays(integrator: mi.Integrator) -> float:
    """Rays of a path."""
    rays = integrator.statistics.rays
    return sum(rays.values()) / rays["camera"]


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--spp", default=64, show_default=True)
@click.option("--rounds", default=4, show_default=True, help="The first one compiles.")
def main(files: tuple[Path, ...], spp: int, rounds: int) -> None:
    """Measures on the scenes FILES."""
    mi.set_variant("llvm_ad_rgb")
    verdicts.is_worth = lambda *_: True
    for file in files:
        scene = mi.load_file(str(file))
        sensor = mi.traverse(scene.sensors()[0])
        sensor["film.size"] = sensor["film.crop_size"] = [160, 90]
        sensor.update()
        made = {
            label: mi.load_dict({"type": "composed_path", "max_depth": 6, **slots})
            for label, slots in INTEGRATORS.items()
        }
        times: dict[str, list[float]] = {label: [] for label in made}
        for seed in range(rounds):
            for label, integrator in made.items():
                mi.render(scene, integrator=integrator, seed=seed, spp=spp)
                told = integrator.statistics
                request = Request(scene, scene.sensors()[0])
                samples = spp - sum(integrator.plan_learning(request, spp).pilots)
                times[label].append((told.seconds - told.learning_seconds) / samples)
        medians = {label: statistics.median(some[1:]) for label, some in times.items()}
        rays = {label: _rays(integrator) for label, integrator in made.items()}
        ray = medians["path"] / rays["path"]
        connections = made["path"].statistics.connections / (160 * 90 * spp)
        for label in list(made)[1:]:
            # Without the rays that it traces more
            event = (medians[label] - rays[label] * ray) / ray
            each = f", {event / connections:.2f} rays a connection" if label == "lights" else ""
            print(
                f"{file.stem}, {label}: {medians[label] / medians['path']:.2f} x the time; beside "
                f"its rays, {event:.2f} rays a path{each}"
            )


if __name__ == "__main__":
    main()
