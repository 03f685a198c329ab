"""Does the memory of a render grow with its samples?

    python benchmarks/long_render_memory.py

renders 100 000 samples per pixel of a small image, and prints the memory of the process on its way.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

SCENE = Path(__file__).parents[1] / "scenes" / "cornell_box.xml"


def resident_mib(process: int) -> float:
    """The memory that a process occupies (Linux)."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * 4096 / 2**20


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--integrator", default="path")
    parser.add_argument("--spp", type=int, default=100_000)
    parser.add_argument("--size", default="64x48")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        process = subprocess.Popen(
            [sys.executable, "-m", "mitsuba_ext", "render", SCENE, "-o", f"{folder}/a.exr",
             "--integrator", arguments.integrator, "--size", arguments.size,
             "--spp", str(arguments.spp), "--checkpoint", f"{folder}/kept", "--every", "10s",
             "--json"],
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        print(f"{arguments.integrator}, {arguments.size}")
        shown = 0
        for line in process.stdout:
            event = json.loads(line)
            if event["event"] == "progress" and event["spp"] >= shown:
                print(f"{event['spp']:8} spp {resident_mib(process.pid):6.0f} MiB", flush=True)
                shown = event["spp"] + arguments.spp // 10
        sys.exit(process.wait())


if __name__ == "__main__":
    main()
