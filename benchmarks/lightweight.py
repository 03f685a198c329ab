"""Memory and speed of lightweight meshes, against Embree in Mitsuba.

    python benchmarks/lightweight.py rays                  # a ball of 1e5, 1e6 and 1e7 triangles
    python benchmarks/lightweight.py rays SCENE.xml        # all meshes of a scene as one
    python benchmarks/lightweight.py heights               # heightfields of 1000 x 1000 cells
    python benchmarks/lightweight.py memory --triangles 2e7
    python benchmarks/lightweight.py renders               # a ball in cornell_box
    python benchmarks/lightweight.py renders SCENE.xml     # with its large meshes as lightweight

``rays`` times the tree with boxes of several precisions: as floats, shorts and bytes relative to
the mesh, as in the source, and bytes relative to the node, which the plugin uses. Camera rays come
from a grid of pixels, diffuse rays from the second surface on the way of a path, and shadow rays
end at points of the box. Times are medians over rounds in which the structures take turns, in units
of Embree's.
"""

from __future__ import annotations

import os
import re
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

import click

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before mitsuba)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip

_MIB = 2**20


def ball(triangles: int) -> tuple[np.ndarray, np.ndarray]:
    """A bumpy ball: positions and faces."""
    rows = int((triangles / 4) ** 0.5)
    u = np.linspace(0, 2 * np.pi, 2 * rows + 1, dtype=np.float32)[:, None]
    v = np.linspace(1e-3, np.pi - 1e-3, rows + 1, dtype=np.float32)[None]
    r = 1 + 0.05 * (
        np.sin(9 * u) * np.sin(11 * v) + np.sin(31 * u + 3) * np.sin(27 * v) / 2
        + np.sin(101 * u) * np.sin(97 * v) / 4
    )  # fmt: skip
    points = [r * np.sin(v) * np.cos(u), r * np.sin(v) * np.sin(u), r * np.cos(v)]
    corner = (np.arange(2 * rows)[:, None] * (rows + 1) + np.arange(rows)).ravel()
    ahead = corner + rows + 1
    faces = [np.stack([corner, corner + 1, ahead + 1]), np.stack([corner, ahead + 1, ahead])]
    return np.stack(points, axis=-1).reshape(-1, 3), np.concatenate(faces, axis=1).T.astype("u4")


def mesh(positions: np.ndarray, faces: np.ndarray) -> mi.Mesh:
    shape = mi.Mesh("mesh", len(positions), len(faces))
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = mi.Float(positions.ravel())
    parameters["faces"] = mi.UInt32(faces.ravel())
    parameters.update()
    return shape


def merged(file: Path) -> tuple[np.ndarray, np.ndarray, mi.Scene]:
    """All meshes of a scene as one, and the scene."""
    scene = mi.load_file(str(file))
    positions, faces, count = [], [], 0
    for shape in scene.shapes():
        if shape.is_mesh():
            positions.append(shape.vertex_positions_buffer().numpy().reshape(-1, 3))
            faces.append(shape.faces_buffer().numpy().reshape(-1, 3) + np.uint32(count))
            count += len(positions[-1])
    return np.concatenate(positions), np.concatenate(faces), scene


# ---- Rays ----


def camera_rays(scene: mi.Scene | None, side: int) -> mi.Ray3f:
    lane = dr.arange(mi.UInt32, side * side)
    place = (mi.Point2f(lane % side, lane // side) + 0.5) / side
    if scene is not None:
        ray = scene.sensors()[0].sample_ray(0, 0.5, place, mi.Point2f(0.5))[0]
    else:
        d = dr.normalize(mi.Vector3f(place.x - 0.5, 1, place.y - 0.5))
        ray = mi.Ray3f(mi.Point3f(0, -2.6, 0.3), d)
    return _evaluated(mi.Ray3f(ray))


def diffuse_rays(scene: mi.Scene, camera: mi.Ray3f) -> mi.Ray3f:
    """From the points that camera rays hit, and again from those, on the side of their origins."""
    ray = camera
    for seed in (1, 2):
        si = scene.ray_intersect(ray)
        rng = mi.PCG32(size=dr.width(camera), initstate=seed)
        sample = mi.Point2f(rng.next_float32(), rng.next_float32())
        frame = mi.Frame3f(mi.Vector3f(dr.mulsign(si.n, -dr.dot(ray.d, si.n))))
        bounced = si.spawn_ray(frame.to_world(mi.warp.square_to_cosine_hemisphere(sample)))
        ray = dr.select(si.is_valid(), bounced, ray)
    return _evaluated(ray)


def shadow_rays(rays: mi.Ray3f, box: mi.ScalarBoundingBox3f) -> mi.Ray3f:
    """From the origins of rays to points of a box."""
    rng = mi.PCG32(size=dr.width(rays), initstate=3)
    sample = mi.Vector3f(rng.next_float32(), rng.next_float32(), rng.next_float32())
    ray = mi.Ray3f(rays)
    ray.d = mi.Point3f(box.min) + sample * mi.Vector3f(box.max - box.min) - rays.o
    ray.maxt = mi.Float(1)
    return _evaluated(ray)


def _evaluated(ray: mi.Ray3f) -> mi.Ray3f:
    dr.eval(ray)
    return ray


# ---- Structures ----


def structures(positions: np.ndarray, faces: np.ndarray, all_of_them: bool) -> dict:
    """The trees by name: functions that make them."""
    from lightweight_nodes import PRECISIONS

    from mitsuba_ext.scene.lightweight.mesh_geometry import MeshGeometry
    from mitsuba_ext.scene.lightweight.packed_mesh import PackedMesh

    made = {
        "ours": lambda: MeshGeometry(mesh(positions, faces)),
        "ours, quantized": lambda: PackedMesh(mesh(positions, faces)),
    }
    if all_of_them:
        for name in PRECISIONS:
            made[name] = partial(_precise, positions, faces, name)
    return made


def _precise(positions: np.ndarray, faces: np.ndarray, name: str):
    from lightweight_nodes import PreciseGeometry

    return PreciseGeometry(mesh(positions, faces), name)


def interleaved(tasks: dict[str, Callable], rounds: int) -> dict[str, float]:
    """Median times."""
    for task in tasks.values():  # compiles
        task()
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for _ in range(rounds):
        for name, task in tasks.items():
            begin = time.perf_counter()
            task()
            times[name].append(time.perf_counter() - begin)
    return {name: statistics.median(values) for name, values in times.items()}


@click.group()
def main() -> None:
    mi.set_variant("llvm_ad_rgb")


@main.command()
@click.argument("scenes", nargs=-1, type=click.Path(exists=True, path_type=Path))
@click.option("--triangles", default="1e5,1e6,1e7", help="Sizes of the ball.")
@click.option("--side", default=1000, help="Rays along each side of the film.")
@click.option("--rounds", default=7)
@click.option("--few", is_flag=True, help="Leave out the precisions of the source.")
def rays(scenes, triangles: str, side: int, rounds: int, few: bool) -> None:
    """Times of rays, in units of Embree's."""
    cases = [(file.parent.name, *merged(file)) for file in scenes]
    if not scenes:
        cases = ((f"ball {n}", *ball(int(float(n))), None) for n in triangles.split(","))
    for name, positions, faces, own in cases:
        scene = mi.load_dict({"type": "scene", "mesh": mesh(positions, faces)}, optimize=False)
        camera = camera_rays(own, side)
        diffuse = diffuse_rays(scene, camera)
        shadow = shadow_rays(diffuse, scene.bbox())
        trees = {}
        for label, make in structures(positions, faces, not few).items():
            begin = time.perf_counter()
            trees[label] = make(), time.perf_counter() - begin
        print(f"{name}: {len(faces)} triangles")
        results = {}
        for kind, ray in (("camera", camera), ("diffuse", diffuse), ("shadow", shadow)):
            tasks = {"Embree": partial(_embree, scene, ray, kind)}
            for label, (tree, _) in trees.items():
                tasks[label] = partial(_ours, tree, ray, kind)
            results[kind] = interleaved(tasks, rounds)
        million = {kind: side * side / 1e6 / times["Embree"] for kind, times in results.items()}
        print("  Embree: " + ", ".join(f"{v:.1f} M {k} rays/s" for k, v in million.items()))
        for label, (tree, seconds) in trees.items():
            ratios = (f"{kind} {t[label] / t['Embree']:.2f}" for kind, t in results.items())
            print(f"  {label}: {tree.nbytes / len(faces):.2f} bytes a triangle, built in "
                  f"{seconds:.1f} s, times {', '.join(ratios)}")  # fmt: skip


@main.command()
@click.option("--cells", default=1000)
@click.option("--side", default=1000)
@click.option("--rounds", default=7)
def heights(cells: int, side: int, rounds: int) -> None:
    """Times of rays in heightfields, in units of Embree's in meshes of the same triangles."""
    y, x = np.mgrid[: cells + 1, : cells + 1] / cells
    hills = np.sin(9 * x) * np.sin(11 * y) + np.sin(37 * x + 3) * np.sin(41 * y) / 4
    hills += np.sin(301 * x) * np.sin(297 * y) / 40
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    above = corner + cells + 1
    faces = [np.stack([corner, corner + 1, above + 1]), np.stack([corner, above + 1, above])]
    faces = np.concatenate(faces, axis=1).T.astype("u4")
    for scale in (0.3, 0.03):
        z = (scale * hills).astype("f4")
        positions = np.stack([2 * x - 1, 2 * y - 1, z], axis=-1).reshape(-1, 3).astype("f4")
        scene = mi.load_dict({"type": "scene", "mesh": mesh(positions, faces)}, optimize=False)
        camera = _evaluated(mi.Ray3f(*_from_above(side)))
        diffuse = diffuse_rays(scene, camera)
        sorts = {"camera": camera, "diffuse": diffuse, "shadow": shadow_rays(diffuse, scene.bbox())}
        print(f"{cells} x {cells} cells, heights of {scale}")
        for kind in ("float32", "uint16"):
            data = {"data": mi.TensorXf(z)}
            if kind == "uint16":
                low, high = z.min(), z.max()
                image = np.rint((z - low) / (high - low) * 65535).astype("u2")
                to_world = mi.ScalarTransform4f().translate([0, 0, float(low)])
                data = {"bitmap": mi.Bitmap(image), "scale": float(high - low)}
                data["to_world"] = to_world
            begin = time.perf_counter()
            field = mi.load_dict({"type": "heightfield", **data}).lightweight
            seconds = time.perf_counter() - begin
            ratios = []
            for name, ray in sorts.items():
                times = interleaved({
                    "Embree": partial(_embree, scene, ray, name),
                    "ours": partial(_ours, field, ray, name),
                }, rounds)  # fmt: skip
                ratios.append(f"{name} {times['ours'] / times['Embree']:.2f}")
            print(f"  {kind}: {field.tree.nbytes / cells**2:.2f} bytes a cell, built in "
                  f"{seconds:.2f} s, times {', '.join(ratios)}")  # fmt: skip


def _from_above(side: int) -> tuple[mi.Point3f, mi.Vector3f]:
    lane = dr.arange(mi.UInt32, side * side)
    place = (mi.Point2f(lane % side, lane // side) + 0.5) / side - 0.5
    o = mi.Point3f(0, -1.8, 1.2)
    return o, dr.normalize(mi.Point3f(1.6 * place.x, 1.6 * place.y, 0) - o)


def _embree(scene: mi.Scene, ray: mi.Ray3f, kind: str) -> None:
    if kind == "shadow":
        dr.eval(scene.ray_test(ray))
    else:
        dr.eval(scene.ray_intersect_preliminary(ray, coherent=kind == "camera"))
    dr.sync_thread()


def _ours(tree, ray: mi.Ray3f, kind: str) -> None:
    query = tree.occluded if kind == "shadow" else tree.closest
    dr.eval(query(ray, mi.Bool(True)))
    dr.sync_thread()


# ---- Memory ----


@main.command()
@click.option("--triangles", default=2e7)
@click.option("--normals/--no-normals", default=False, help="Keep the normals that Mitsuba makes.")
def memory(triangles: float, normals: bool) -> None:
    """Resident memory and its peak while a scene with the ball is loaded and rendered."""
    file = Path(os.environ.get("TMPDIR", "/tmp")) / f"ball_{int(triangles)}.ply"
    if not file.exists():
        write_ply(file, *ball(int(triangles)))
    for kind in ("mesh", "lightweight_mesh", "quantized", "heightfield"):
        command = [sys.executable, __file__, "one", kind, str(file)]
        subprocess.run(command + ["--normals"] * normals, check=True)


def write_ply(file: Path, positions: np.ndarray, faces: np.ndarray) -> None:
    table = np.empty(len(faces), dtype=[("count", "u1"), ("vertices", "<i4", 3)])
    table["count"], table["vertices"] = 3, faces
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(positions)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    file.write_bytes(header.encode() + positions.astype("<f4").tobytes() + table.tobytes())


@main.command(hidden=True)
@click.argument("kind")
@click.argument("file")
@click.option("--normals", is_flag=True)
def one(kind: str, file: str, normals: bool) -> None:
    dr.eval(mi.Float([1, 2]))
    base = _resident()
    shape = {"type": "ply", "filename": file, "face_normals": not normals}
    if kind == "heightfield":  # with as many triangles
        count = round((int(file.split("_")[-1][:-4]) / 2) ** 0.5) + 1
        rows = mi.Float(np.sin(np.linspace(0, 40, count * count, dtype="f4")))
        heights = mi.TensorXf(rows, (count, count))
        shape = {"type": "heightfield", "data": heights, "scale": 0.2, "face_normals": not normals}
    elif kind != "mesh":
        shape = {"type": "lightweight_mesh", "quantized": kind == "quantized", "mesh": shape}
    to_world = mi.ScalarTransform4f().look_at([0, -2.6, 0.3], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 320, "height": 240}
    sensor = {"type": "perspective", "fov": 50, "to_world": to_world, "film": film}
    begin = time.perf_counter()
    scene = mi.load_dict(
        {"type": "scene", "ball": shape, "sensor": sensor, "sky": {"type": "constant"}},
        optimize=False,
    )
    seconds = time.perf_counter() - begin
    dr.flush_malloc_cache()
    resident = _resident()
    name = "path" if kind == "mesh" else "composed_path"
    integrator = mi.load_dict({"type": name, "max_depth": 4})
    dr.eval(integrator.render(scene, spp=4))
    # ru_maxrss would begin with the peak of the process that started this one
    (peak,) = re.findall(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    peak = int(peak) / 1024
    print(f"{kind}: {resident:.0f} MiB resident ({base:.0f} without a scene), peak {peak:.0f} MiB, "
          f"loaded in {seconds:.0f} s")  # fmt: skip


def _resident() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / _MIB


# ---- Renders ----


@main.command()
@click.argument("scenes", nargs=-1, type=click.Path(exists=True, path_type=Path))
@click.option("--triangles", default="1e5,1e6,1e7")
@click.option("--least", default=400_000, help="Files of a scene that are wrapped, in bytes.")
@click.option("--rounds", default=5)
def renders(scenes, triangles: str, least: int, rounds: int) -> None:
    """Times of ``composed_path``, in units of those with Mitsuba's meshes: with a ball in
    cornell_box, or with the large meshes of SCENES as lightweight ones."""
    cases = [(file.parent.name, partial(_wrapped, file, least)) for file in scenes]
    if not scenes:
        cases = [(f"{n} triangles", partial(_with_ball, float(n))) for n in triangles.split(",")]
    for name, make in cases:
        made = {kind: make(kind) for kind in ("mesh", "lightweight_mesh", "quantized")}
        integrator = mi.load_dict({"type": "composed_path", "max_depth": 8})
        tasks = {kind: partial(_rendered, integrator, scene) for kind, scene in made.items()}
        times = interleaved(tasks, rounds)
        print(f"{name}: mesh {times['mesh']:.2f} s, " + ", ".join(
            f"{kind} {seconds / times['mesh']:.2f} ×" for kind, seconds in times.items()
        ), flush=True)  # fmt: skip


def _with_ball(triangles: float, kind: str) -> mi.Scene:
    positions, faces = ball(int(triangles))
    shape = mesh(0.45 * positions, faces)
    if kind != "mesh":
        shape = mi.load_dict({
            "type": "lightweight_mesh", "quantized": kind == "quantized", "mesh": shape,
        })  # fmt: skip
    box = mi.cornell_box()
    for key in ("small-box", "large-box"):
        box.pop(key)
    return mi.load_dict({**box, "ball": shape}, optimize=False)


def _wrapped(file: Path, least: int, kind: str) -> mi.Scene:
    """A scene with its large meshes in lightweight ones."""
    root, count = ElementTree.parse(file).getroot(), 0
    for index, shape in enumerate(root):
        name = shape.find("string[@name='filename']")
        if shape.tag != "shape" or name is None:
            continue
        if kind != "mesh" and (file.parent / name.get("value")).stat().st_size >= least:
            outer = ElementTree.Element("shape", type="lightweight_mesh")
            ElementTree.SubElement(
                outer, "boolean", name="quantized", value=str(kind == "quantized").lower()
            )
            outer.append(shape)
            root[index] = outer
            count += 1
    print(f"  {kind}: {count} meshes", flush=True)
    mi.file_resolver().prepend(str(file.parent))
    text = ElementTree.tostring(root, encoding="unicode")
    return mi.load_string(text, resx="320", resy="180")


def _rendered(integrator: mi.Integrator, scene: mi.Scene) -> None:
    dr.eval(integrator.render(scene, spp=16))
    dr.sync_thread()


if __name__ == "__main__":
    main()
