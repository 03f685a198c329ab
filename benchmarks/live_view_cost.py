"""How much CPU time does a page cost that shows a render?

    python benchmarks/live_view_cost.py

renders without a page and with one, in turn, while a client asks for the state and each new image,
as a browser does. It prints the median of the CPU time of the process, in seconds, start included.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

SCENE = Path(__file__).parents[1] / "scenes" / "mirrors_and_glass.xml"


def look(address: str) -> int:
    """Asks like a page until the server ends; returns the number of images."""
    number, count = 0, 0
    try:
        while True:
            state = json.load(urllib.request.urlopen(f"{address}state?page=a&number={number}"))
            if state["pictures"] and state["pictures"][0]["number"] > number:
                number, name = state["pictures"][0]["number"], state["pictures"][0]["name"]
                urllib.request.urlopen(f"{address}image?name={name}").read()
                count += 1
            time.sleep(1)
    except OSError:
        return count


def cpu_seconds(integrator: str, size: str, spp: int, is_shown: bool) -> tuple[float, int]:
    """The CPU time of a render, and the number of images that its page showed."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    count = 0
    with tempfile.TemporaryDirectory() as folder:
        process = subprocess.Popen(
            [sys.executable, "-m", "mitsuba_ext", "render", SCENE, "-o", f"{folder}/a.exr",
             "--json", "--integrator", integrator, "--size", size, "--spp", str(spp),
             *(["--serve", "0"] if is_shown else [])],
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        if is_shown:
            count = look(json.loads(process.stdout.readline())["address"])
        process.communicate()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return used, count


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--integrator", default="composed_path")
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--spp", type=int, default=32)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    render = arguments.integrator, arguments.size, arguments.spp
    cpu_seconds(*render, True)  # compiles kernels
    found: dict[bool, list[float]] = {False: [], True: []}
    for _ in range(arguments.repeats):
        for is_shown, times in found.items():
            used, count = cpu_seconds(*render, is_shown)
            times.append(round(used, 2))
    plain, shown = (statistics.median(found[x]) for x in (False, True))
    print(f"without a page: {plain:.1f} s of CPU time {found[False]}")
    print(f"with a page:    {shown:.1f} s of CPU time {found[True]}, {count} images")
    print(f"ratio:          {shown / plain:.3f}")


if __name__ == "__main__":
    main()
