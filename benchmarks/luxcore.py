"""Compares ``path`` and ``bdpt`` (and others: ``--integrator``) with BIDIRCPU, the bidirectional
path tracer of LuxCore, or with another engine, by variance and CPU time:

    python3 -m venv luxcore && luxcore/bin/pip install pyluxcore numpy
    .venv/bin/python benchmarks/luxcore.py cornell_box caustic --python luxcore/bin/python
    .venv/bin/python benchmarks/luxcore.py caustic --python luxcore/bin/python --integrator bdpt \\
        --integrator vcm --engine BIDIRVMCPU:bidirvm.startradius.scale=0.0003

The scene is handed over as meshes, to another process: LuxCore's libraries and Mitsuba's do not go
together in one. It must be made of ``diffuse``, smooth ``dielectric`` and smooth ``conductor`` (a
mirror of the same colour there), area lights and a ``perspective`` camera, and is rendered as a
square. Errors and times are those of ``benchmarks/equal_samples.py``, with the mean of all images
of ``bdpt``. Images of LuxCore are scaled to that mean; ``mean`` shows by how much they differed.
"""

from __future__ import annotations

import pickle
import subprocess
import tempfile
from pathlib import Path

import click
import numpy as np
from equal_samples import (
    Renders,
    error,
    load,
    options,
    print_header,
    print_row,
    render_in_turns,
    title,
)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

#: Rows of quads around spheres and cylinders.
_STEPS = 192

COLUMNS = ["scene", "", "seconds", "error", "efficiency", "mean"]


@click.command()
@options
@click.option("--python", required=True, help="An interpreter with pyluxcore and numpy.")
@click.option("--integrator", "kinds", multiple=True, default=("path", "bdpt"))
@click.option("--engine", "engines", multiple=True, default=("BIDIRCPU",),
              help="Engines of LuxCore, with parameters: NAME:key=value:key=value.")  # fmt: skip
def main(names, max_depth, spp, seeds, size, python, kinds, engines) -> None:
    """Compares the integrators on the scenes NAMES."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    print_header(COLUMNS)
    side = size[1]
    for name in names:
        scene = load(name, (side, side))
        jobs = {kind: (scene, {"type": kind, "max_depth": max_depth}, spp) for kind in kinds}
        renders = render_in_turns(jobs, seeds)
        mean = renders["bdpt"].mean
        for engine in engines:
            renders[engine] = _theirs(scene, python, engine, side, max_depth, spp, seeds)
        cost_of_path = None
        for kind, found in renders.items():
            ratio = found.mean.mean() / mean.mean()
            e = error(found.variance / ratio**2, mean)
            cost_of_path = cost_of_path or e * found.time
            row = [f"{found.time:.2f}", f"{e:.2g}", f"{cost_of_path / (e * found.time):.2g}"]
            print_row([title(name), kind, *row, f"{ratio:.3f}"])


def _theirs(
    scene: mi.Scene, python: str, engine: str, side: int, max_depth: int, spp: int, seeds: int
) -> Renders:
    """Renders of LuxCore."""
    shapes = [(_material(shape), *_mesh(shape)) for shape in scene.shapes()]
    task = {"camera": _camera(scene.sensors()[0]), "shapes": shapes, "side": side}
    kind, *parameters = engine.split(":")
    task |= {"max_depth": max_depth, "spp": spp, "seeds": seeds, "engine": kind}
    task["parameters"] = {k: float(v) for k, v in (text.split("=") for text in parameters)}
    with tempfile.TemporaryDirectory() as folder:
        given, made = Path(folder) / "task", Path(folder) / "renders"
        given.write_bytes(pickle.dumps(task))
        script = Path(__file__).with_name("luxcore_renders.py")
        subprocess.run([python, script, given, made], check=True, capture_output=True)
        return Renders(*pickle.loads(made.read_bytes()))


def _camera(sensor: mi.Sensor) -> dict:
    to_world = np.array(sensor.world_transform().matrix, dtype=float).reshape(4, 4)
    origin, ahead, up = to_world[:3, 3], to_world[:3, 2], to_world[:3, 1]
    return {
        "type": "perspective",
        "lookat.orig": origin.tolist(),
        "lookat.target": (origin + ahead).tolist(),
        "up": up.tolist(),
        "fieldofview": float(mi.traverse(sensor)["x_fov"][0]),
        "autovolume.enable": 0,
    }


def _material(shape: mi.Shape) -> dict:
    """Its parameters, without the name of the material."""
    bsdf = shape.bsdf()
    while bsdf.class_name() == "TwoSidedBRDF":
        bsdf = _nested(bsdf)
    parameters, kind = mi.traverse(bsdf), bsdf.class_name()
    if kind == "SmoothDiffuse":
        found = {"type": "matte", "kd": _colour(parameters, "reflectance")}
    elif kind == "SmoothDielectric":
        found = {"type": "glass", "kr": [1.0] * 3, "kt": [1.0] * 3}
        found |= {"interiorior": float(parameters["eta"]), "exteriorior": 1.0}
    elif kind == "SmoothConductor":
        weight = bsdf.sample(mi.BSDFContext(), _from_front(), 0.5, mi.Point2f(0.5))[1]
        found = {"type": "mirror", "kr": [float(w[0]) for w in weight]}
    else:
        raise NotImplementedError(f"{kind} is not handed over")
    if shape.is_emitter():
        radiance = [float(v[0]) for v in shape.emitter().eval(_from_front())]
        found |= {"emission": radiance, "emission.normalizebycolor": 0}
        found |= {"emission.gain": [1.0] * 3, "emission.power": 0.0}
    return found


def _from_front() -> mi.SurfaceInteraction3f:
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(0, 0, 1)
    return si


def _nested(bsdf: mi.BSDF) -> mi.BSDF:
    found = []

    class Nested(mi.TraversalCallback):
        def put(self, _name: str, value: object, _flags: int, *_more: object) -> None:
            if isinstance(value, mi.BSDF):
                found.append(value)

    bsdf.traverse(Nested())
    return found[0]


def _colour(parameters: mi.SceneParameters, name: str) -> list[float]:
    for key, value in parameters.items():
        if key.startswith(name) and key.endswith("value"):
            return np.broadcast_to(np.array(value, dtype=float).ravel(), 3).tolist()
    raise NotImplementedError(f"only a {name} of one colour is handed over")


def _mesh(shape: mi.Shape) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    """Vertices, normals (or none) and faces."""
    if shape.is_mesh():
        vertices = np.array(shape.vertex_positions_buffer()).reshape(-1, 3)
        normals = np.array(shape.vertex_normals_buffer()).reshape(-1, 3)
        faces = np.array(shape.faces_buffer()).reshape(-1, 3)
        return vertices, normals if len(normals) == len(vertices) else None, faces
    kind = shape.class_name()
    steps = 1 if kind == "Rectangle" else _STEPS
    u, v = np.meshgrid(np.linspace(0, 1, steps + 1), np.linspace(0, 1, steps + 1), indexing="ij")
    u, v = u.ravel(), v.ravel()
    φ, θ = 2 * np.pi * u, np.pi * v
    if kind == "Rectangle":
        local = np.stack([2 * u - 1, 2 * v - 1, 0 * u], axis=1)
        normal = np.tile([0.0, 0.0, 1.0], (len(u), 1))
    elif kind == "Sphere":
        local = np.stack([np.sin(θ) * np.cos(φ), np.sin(θ) * np.sin(φ), -np.cos(θ)], axis=1)
        normal = local
    elif kind == "Cylinder":
        local = np.stack([np.cos(φ), np.sin(φ), v], axis=1)
        normal = local * [1, 1, 0]
    else:
        raise NotImplementedError(f"{kind} is not handed over")
    to_world = np.array(mi.traverse(shape)["to_world"].matrix, dtype=float).reshape(4, 4)
    vertices = local @ to_world[:3, :3].T + to_world[:3, 3]
    normals = normal @ np.linalg.inv(to_world[:3, :3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    i, j = np.meshgrid(np.arange(steps), np.arange(steps), indexing="ij")
    a = (i * (steps + 1) + j).ravel()
    b, c, d = a + steps + 1, a + steps + 2, a + 1
    return vertices, normals, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


if __name__ == "__main__":
    main()
