"""What it costs to keep a render of 1920 × 1080 pixels.

    python benchmarks/checkpoint_cost.py

renders a scene with and without checkpoints, in turn, and prints the seconds of a checkpoint and
its share of an interval of 60 seconds.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

SCENE = Path(__file__).parents[1] / "scenes" / "cornell_box.xml"


def seconds_of(every: str, spp: int, scene: Path, size: str) -> float:
    """The time of a render that is kept so often, by its own account."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable, "-m", "mitsuba_ext", "render", str(scene), "-o", f"{folder}/a.exr",
            "--integrator", "path:max_depth=2", "--size", size, "--spp", str(spp),
            "--checkpoint", f"{folder}/kept", "--every", every, "--json",
        ]  # fmt: skip
        lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        return json.loads(lines.splitlines()[-1])["seconds"]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--scene", type=Path, default=SCENE)
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--spp", type=int, default=32, help="samples per pixel of each render")
    parser.add_argument("--every", type=int, default=4, help="samples per pixel of an interval")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    count = arguments.spp // arguments.every - 1  # both keep it in the end
    costs = []
    for _ in range(arguments.rounds):
        plain = seconds_of("1h", arguments.spp, arguments.scene, arguments.size)
        kept = seconds_of(
            f"{arguments.every}spp", arguments.spp, arguments.scene, arguments.size
        )
        costs.append((kept - plain) / count)
        print(f"{plain:.1f} s, with {count} checkpoints {kept:.1f} s", flush=True)
    median = statistics.median(costs)
    print(f"a checkpoint takes {median:.2f} s: {median / 60:.1%} of 60 s")


if __name__ == "__main__":
    main()
