"""Renders for ``benchmarks/luxcore.py`` with LuxCore, in a process without Mitsuba.

    python luxcore_renders.py TASK RENDERS
"""

from __future__ import annotations

import pickle
import sys
import time
from pathlib import Path

import numpy as np
import pyluxcore


def main(given: Path, made: Path) -> None:
    pyluxcore.Init()
    task = pickle.loads(given.read_bytes())
    scene = pyluxcore.Scene()
    scene.Parse(_properties({f"scene.camera.{k}": v for k, v in task["camera"].items()}))
    for n, (material, vertices, normals, faces) in enumerate(task["shapes"]):
        scene.Parse(_properties({f"scene.materials.m{n}.{k}": v for k, v in material.items()}))
        scene.DefineMesh(
            f"s{n}", [tuple(map(float, v)) for v in vertices],
            [tuple(map(int, f)) for f in faces],
            None if normals is None else [tuple(map(float, v)) for v in normals],
            None, None, None,
        )  # fmt: skip
        scene.Parse(_properties({
            f"scene.objects.o{n}.shape": f"s{n}", f"scene.objects.o{n}.material": f"m{n}",
        }))  # fmt: skip
    renders = [_render(scene, task, seed) for seed in range(1, task["seeds"] + 1)]
    made.write_bytes(pickle.dumps(tuple(map(list, zip(*renders)))))


def _render(scene: pyluxcore.Scene, task: dict, seed: int) -> tuple[np.ndarray, float]:
    """An image, [height, width, channel], and the seconds of CPU time that it took."""
    side, depth = task["side"], task["max_depth"]
    config = pyluxcore.RenderConfig(
        _properties({
            "renderengine.type": task["engine"], "renderengine.seed": seed,
            "sampler.type": "RANDOM",
            "native.threads.count": 2, "path.maxdepth": depth, "light.maxdepth": depth,
            "film.width": side, "film.height": side, "film.filter.type": "NONE",
            "film.outputs.0.type": "RGB", "film.outputs.0.filename": "unused.exr",
            "batch.haltspp": task["spp"], **task["parameters"],
        }),
        scene,
    )  # fmt: skip
    session = pyluxcore.RenderSession(config)
    session.Start()
    start = time.process_time()
    while not session.HasDone():
        session.UpdateStats()
        time.sleep(0.005)
    seconds = time.process_time() - start
    session.Stop()
    image = np.zeros((side, side, 3), np.float32)
    session.GetFilm().GetOutputFloat(pyluxcore.FilmOutputType.RGB, image)
    return image[::-1].astype(np.float64), seconds


def _properties(values: dict) -> pyluxcore.Properties:
    made = pyluxcore.Properties()
    for key, value in values.items():
        made.Set(pyluxcore.Property(key, value))
    return made


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
