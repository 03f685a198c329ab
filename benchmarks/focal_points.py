"""Draws the focal points that were learned in a scene, from above and from the front:
``benchmarks/focal_points.py scenes/keyhole.xml docs/figures/focal_points.jpg``.
"""

from __future__ import annotations

from pathlib import Path

import click

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before mitsuba)

import mitsuba as mi  # isort: skip
import matplotlib as mpl  # isort: skip
import matplotlib.pyplot as plt  # isort: skip
import numpy as np  # isort: skip

#: Cells of the picture along each axis.
_CELLS = 400


def edges(scene: mi.Scene) -> np.ndarray:
    """The edges of all meshes at which faces of different planes meet; shape [edges, 2, 3]."""
    found = []
    for shape in scene.shapes():
        if not shape.is_mesh() or shape.face_count() > 2000:
            continue
        points = np.array(shape.vertex_positions_buffer()).reshape(-1, 3).round(4)
        faces = points[np.array(shape.faces_buffer()).reshape(-1, 3)]
        normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        seen: dict[tuple, list[np.ndarray]] = {}
        for face, normal in zip(faces, normals):
            for i in range(3):
                ends = tuple(sorted(map(tuple, (face[i], face[(i + 1) % 3]))))
                seen.setdefault(ends, []).append(normal)
        for ends, sides in seen.items():
            if len(sides) != 2 or abs(sides[0] @ sides[1]) < 0.99:
                found.append(ends)
    return np.array(found).reshape(-1, 2, 3)


def projection(low, high, probability, axes, bounds) -> np.ndarray:
    """The density of focal points, integrated along the third axis; shape [y, x]."""
    xs, ys = (np.linspace(*bounds[:, axis], _CELLS) for axis in axes)
    image = np.zeros((_CELLS, _CELLS))
    for a, b, p in zip(low[:, axes], high[:, axes], probability):
        inside = ((ys >= a[1]) & (ys < b[1]))[:, None] & ((xs >= a[0]) & (xs < b[0]))
        image += inside * p / np.prod(b - a)
    return image


@click.command()
@click.argument("scene_file", type=click.Path(exists=True))
@click.argument("output", type=click.Path())
@click.option("--spp", default=128, help="Samples per pixel.")
def main(scene_file: str, output: str, spp: int) -> None:
    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_file(scene_file, width=160, height=90)
    integrator = mi.load_dict({"type": "composed_path", "scattering": "focal", "max_depth": 6})
    integrator.render(scene, spp=spp, seed=1)
    decision = integrator.learners["scattering"].decision
    if decision is None:
        raise click.ClickException(integrator.statistics.learned)
    density = decision.density
    probability = np.diff(density.table[0, 1:], prepend=0)
    lines = edges(scene)
    points = lines.reshape(-1, 3)
    bounds = np.stack([points.min(axis=0) - 0.2, points.max(axis=0) + 0.2])
    figure, both = plt.subplots(1, 2, figsize=(8, 3.4), layout="constrained")
    for plot, axes, title in zip(both, ([0, 1], [1, 2]), ("from above", "from the side")):
        image = projection(density.low, density.high, probability, axes, bounds)
        extent = bounds[:, axes].T.ravel()
        norm = mpl.colors.LogNorm(image.max() * 1e-4, image.max(), clip=True)
        plot.imshow(image + 1e-9, origin="lower", extent=extent, cmap="inferno", norm=norm)
        segments = mpl.collections.LineCollection(lines[:, :, axes], colors="#888", lw=0.5)
        plot.add_collection(segments)
        plot.set(title=f"{Path(scene_file).stem}, {title}", xlabel="xyz"[axes[0]] + " (m)",
                 ylabel="xyz"[axes[1]] + " (m)")  # fmt: skip
    figure.savefig(output, dpi=110, pil_kwargs={"quality": 82})


if __name__ == "__main__":
    main()
