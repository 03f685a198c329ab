"""Measures what memory maps of samples take beside plain paths:
``.venv/bin/python benchmarks/swarm_memory.py`` (a few minutes).

The scene is scenes/paperweight.xml in fog, rendered in a spectral variant, which asks for all maps:
time, lens, wavelength, distance, lights, lobes, directions. Each render is a process of its own:
its peak resident memory holds what is on the device and what is on the host. Kernels of both are
small beside that.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import click

ROOT = Path(__file__).parents[1]


def render(kind: str, width: int, height: int, spp: int) -> None:
    """Renders in this process, and prints its memory as JSON."""
    import mitsuba_ext  # noqa: F401

    import mitsuba as mi  # isort: skip

    mi.set_variant("llvm_ad_spectral")
    mi.set_log_level(mi.LogLevel.Error)
    scene = mi.load_file(str(ROOT / "scenes/paperweight_in_fog.xml"), width=width, height=height)
    maps = {"direction_map": True, "always_use": True} if kind == "swarm_path" else {}
    integrator = mi.load_dict({"type": kind, "max_depth": 6, **maps})
    begin = time.process_time()
    mi.render(scene, integrator=integrator, spp=spp).numpy()
    statistics = integrator.statistics
    print(json.dumps({
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "device": statistics.memory / 2**30,
        "seconds": time.process_time() - begin,
        "learned": statistics.learned,
    }))  # fmt: skip


@click.command()
@click.option("--width", default=1920, show_default=True)
@click.option("--height", default=1080, show_default=True)
@click.option("--spp", default=16, show_default=True)
@click.option("--only", type=click.Choice(["composed_path", "swarm_path"]), hidden=True)
def main(width: int, height: int, spp: int, only: str | None) -> None:
    """Measures peak memory."""
    if only:
        render(only, width, height, spp)
        return
    fog = [sys.executable, ROOT / "benchmarks/in_fog.py", ROOT / "scenes/paperweight.xml", "0.03"]
    subprocess.run(fog, check=True)
    peaks = {}
    for kind in ("composed_path", "swarm_path"):
        size = ["--width", str(width), "--height", str(height), "--spp", str(spp)]
        command = [sys.executable, __file__, *size, "--only", kind]
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        found = json.loads(output.splitlines()[-1])
        peaks[kind] = found["peak"]
        print(
            f"{kind}: {found['peak']:.2f} GiB resident, {found['device']:.2f} GiB on the device, "
            f"{found['seconds']:.0f} CPU s; {found['learned']}",
            flush=True,
        )
    (ROOT / "scenes/paperweight_in_fog.xml").unlink()
    print(f"difference: {peaks['swarm_path'] - peaks['composed_path']:.2f} GiB")


if __name__ == "__main__":
    main()
