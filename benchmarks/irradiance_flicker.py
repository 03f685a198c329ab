"""Flicker of a flight through a scene at equal time: an irradiance cache with a file, ``path``, and
denoised ``path``.

``.venv/bin/python benchmarks/irradiance_flicker.py [FRAMES]`` prints, for each, the mean over the
pixels of the standard deviation over time of the error (the image minus the reference of the
frame), and the root of the mean squared error, both in units of the mean radiance. Radiance is
clipped at 1.
"""

import sys
import tempfile
import time
from pathlib import Path

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)
from mitsuba_ext.images.denoising import denoise
from mitsuba_ext.rendering.scene_guides import render_guides

import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "cornell_box.xml"
SIZE, DEPTH, SPP, REFERENCE_SPP = (144, 120), 8, 16, 384

mi.set_variant("llvm_ad_rgb")
frames = int(sys.argv[1]) if len(sys.argv) > 1 else 20
scene = mi.load_file(str(SCENE), width=str(SIZE[0]), height=str(SIZE[1]), rfilter="box")
camera = mi.traverse(scene.sensors()[0])
start = mi.ScalarTransform4f(np.array(camera["to_world"].matrix).reshape(4, 4))


def move(frame: int) -> None:
    """The camera goes sideways and forward."""
    camera["to_world"] = mi.Transform4f(start @ mi.ScalarTransform4f().translate(
        [0.01 * frame, 0, 0.01 * frame]
    ))  # fmt: skip
    camera.update()


def image(integrator: mi.Integrator, seed: int, spp: int) -> np.ndarray:
    return np.array(mi.render(scene, integrator=integrator, seed=seed, spp=spp))[..., :3]


def denoised(noisy: np.ndarray) -> np.ndarray:
    guides = render_guides(scene, scene.sensors()[0])
    albedo, normal = np.split(np.stack(list(guides.values()), axis=2), 2, axis=2)
    return np.array(denoise(noisy, albedo, normal))


path = mi.load_dict({"type": "path", "max_depth": DEPTH})
with tempfile.TemporaryDirectory() as folder:
    cache, warm = (
        mi.load_dict({
            "type": "irradiance_cache", "max_depth": DEPTH, "cache_file": f"{folder}/{name}.npz",
        })
        for name in ("cache", "warm")
    )  # fmt: skip
    for integrator in (warm, path):  # compiles
        image(integrator, 0, SPP)
    images: dict[str, list[np.ndarray]] = {"cache": [], "path": [], "denoised path": []}
    seconds: dict[str, list[float]] = {name: [] for name in images}
    references = []
    for frame in range(frames):
        move(frame)
        begin = time.perf_counter()
        images["cache"].append(image(cache, frame + 1, SPP))
        seconds["cache"].append(time.perf_counter() - begin)
        made = sum(r.made for r in cache.rounds)
        print(f"frame {frame}: {made} new of {len(cache.records)}, {seconds['cache'][-1]:.2f} s")
    mean = float(np.mean(seconds["cache"]))
    begin = time.perf_counter()
    image(path, 77, SPP)
    path_spp = max(1, round(SPP * mean / (time.perf_counter() - begin)))
    for frame in range(frames):
        move(frame)
        begin = time.perf_counter()
        images["path"].append(image(path, 100 + frame, path_spp))
        seconds["path"].append(time.perf_counter() - begin)
        images["denoised path"].append(denoised(images["path"][-1]))
        seconds["denoised path"].append(time.perf_counter() - begin)
        references.append(image(path, 1000 + frame, REFERENCE_SPP))
# As a display shows them: otherwise, the edges of the lamp decide
R = np.clip(np.stack(references), 0, 1)
print(f"{frames} frames; cache {SPP} spp, path {path_spp} spp, references {REFERENCE_SPP} spp")
for name, sequence in images.items():
    error = np.clip(np.stack(sequence), 0, 1) - R
    flicker = error.std(axis=0).mean() / R.mean()
    rmse = np.sqrt((error**2).mean()) / R.mean()
    print(f"{name:14s} flicker {flicker:.4f}  RMSE {rmse:.4f}  {np.mean(seconds[name]):.2f} s")
