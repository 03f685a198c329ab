"""Recovers a cloud from three pictures of it: the extinction and the albedo in each voxel of a grid
that begins empty.

    python examples/inverse_cloud.py

``composed_prb`` computes the gradients; for comparison, Mitsuba's ``prbvolpath`` then takes as many
steps. Prints the error at the end, and writes ``inverse_cloud.png``: the true cloud and the two
recovered ones, from another side.
"""

from __future__ import annotations

import sys
import time

import numpy as np

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses an LLVM library that works)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

SIZE, GRID, MAX_DEPTH, SPP = 48, 12, 8, 16

mi.set_variant("llvm_ad_rgb")
T = mi.ScalarTransform4f


def camera(angle: float) -> dict:
    x, y = 5 * np.sin(np.radians(angle)), 5 * np.cos(np.radians(angle))
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    view = T().look_at([x, 1.5, y], [0, 0, 0], [0, 1, 0])
    return {"type": "perspective", "to_world": view, "fov": 32.0, "film": film}


def scene(extinction: np.ndarray, albedo: np.ndarray) -> mi.Scene:
    """A cloud in the cube from −1 to 1, in front of the sky, and lit by a lamp."""
    place = T().translate(-1).scale(2)
    sigma_t, colour = (
        {"type": "gridvolume", "grid": mi.VolumeGrid(values.astype(np.float32)),
         "to_world": place, "raw": True}
        for values in (extinction, albedo)
    )  # fmt: skip
    cloud = {"type": "heterogeneous", "sigma_t": sigma_t, "albedo": colour, "scale": 10.0}
    return mi.load_dict({
        "type": "scene",
        **{f"camera_{angle}": camera(angle) for angle in (0, 120, 240, 60)},
        "cloud": {"type": "cube", "bsdf": {"type": "null"}, "interior": cloud},
        "sky": {"type": "constant", "radiance": 0.3},
        "lamp": {"type": "sphere", "center": [2, 4, 2], "radius": 0.5,
                 "emitter": {"type": "area", "radiance": 40.0}},
    }, optimize=False)  # fmt: skip


def true_cloud() -> tuple[np.ndarray, np.ndarray]:
    """Three balls of different colours: the extinction, and the albedo."""
    at = np.stack(np.meshgrid(*[np.linspace(-1, 1, GRID)] * 3, indexing="ij"), axis=-1)[..., ::-1]
    extinction, albedo = np.zeros((GRID,) * 3 + (1,)), np.full((GRID,) * 3 + (3,), 0.6)
    for centre, colour in (
        ([-0.35, -0.3, 0.2], [0.95, 0.5, 0.4]),
        ([0.4, -0.2, -0.3], [0.4, 0.9, 0.5]),
        ([0, 0.4, 0.1], [0.5, 0.6, 0.95]),
    ):
        inside = np.linalg.norm(at - centre, axis=-1) < 0.42
        extinction[inside], albedo[inside] = 0.8, colour
    return extinction, albedo


def recover(name: str, steps: int, targets: list[mi.TensorXf]) -> tuple[mi.TensorXf, float]:
    """A picture of the recovered cloud from a new side, and the mean error of the pictures."""
    cloud = scene(np.zeros((GRID,) * 3 + (1,)), np.full((GRID,) * 3 + (3,), 0.6))
    parameters = mi.traverse(cloud)
    keys = [key for key in parameters.keys() if key.endswith(("sigma_t.data", "albedo.data"))]
    integrator = mi.load_dict({"type": name, "max_depth": MAX_DEPTH})
    optimizer = mi.ad.Adam(lr=0.02)
    for key in keys:
        optimizer[key] = parameters[key]
    begin = time.perf_counter()
    for step in range(steps):
        parameters.update(optimizer)
        view = step % len(targets)
        image = mi.render(
            cloud, parameters, integrator=integrator, sensor=view, seed=step, spp=SPP
        )
        dr.backward(dr.mean(dr.square(image - targets[view]), axis=None))
        optimizer.step()
        for key in keys:
            limits = (0.0, 1.0) if "sigma_t" in key else (0.05, 0.99)
            optimizer[key] = dr.clip(optimizer[key], *limits)
    seconds = time.perf_counter() - begin
    parameters.update(optimizer)
    path = mi.load_dict({"type": "composed_path", "max_depth": MAX_DEPTH})
    images = [mi.render(cloud, integrator=path, sensor=n, spp=256) for n in range(4)]
    error = float(np.mean([np.abs(np.array(a - b)).mean() for a, b in zip(images, targets)]))
    print(f"{name}: {steps} steps in {seconds:.0f} s, a mean error of {error:.4f}", flush=True)
    return images[3], error


def main(steps: int = 60) -> None:
    truth = scene(*true_cloud())
    path = mi.load_dict({"type": "composed_path", "max_depth": MAX_DEPTH})
    targets = [mi.render(truth, integrator=path, sensor=n, spp=1024) for n in range(4)]
    found = [recover(name, steps, targets[:3])[0] for name in ("composed_prb", "prbvolpath")]
    row = np.concatenate([np.array(image) for image in (targets[3], *found)], axis=1)
    mi.util.write_bitmap("inverse_cloud.png", mi.TensorXf(row), write_async=False)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
