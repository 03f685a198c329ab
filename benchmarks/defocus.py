"""Compares depth of field by a filter (``ecoc_dof``) with that of a traced thin lens:

    .venv/bin/python benchmarks/defocus.py hairball defocus kitchen sponza --pictures out/defocus

Writes a row of Markdown for each scene and filter, and a picture of a part of each image: the
reference, and the filters in the order of the table. FLIP and SSIM are those against ``path`` with
the ``thinlens`` at many samples, whose noise both contain. The last columns are for the filter of
lens points: how many samples ``path`` takes to reach the same FLIP, and how much longer these take
(the smaller of two CPU times of each, in turns, with all samples of what is hidden and the filter).

``hairball`` and ``lamps`` are scenes of this file. The real scenes are looked for in
../shared/scenes; they get a thin lens.
"""

from __future__ import annotations

import time
from pathlib import Path

import click
import defocus_rivals  # noqa: F401  (adds its filters)
import numpy as np
from equal_samples import load, print_header, print_row
from scipy.ndimage import gaussian_filter

from mitsuba_ext.estimators.defocus.filters import FILTERS
from mitsuba_ext.images.flip import mean_flip

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

REAL = Path(__file__).parents[2] / "shared" / "scenes"

#: Of real scenes: aperture radius and focus distance.
LENSES = {"kitchen": (0.15, 6.0), "sponza": (0.3, 8.0)}

#: What the picture of a scene shows, in shares of the film: left, top, right, bottom.
PARTS = {"hairball": (0.1, 0.15, 0.7, 0.8), "defocus": (0.3, 0.0, 0.9, 0.6)}

COLUMNS = ["scene", "filter", "FLIP", "SSIM", "samples of `path` at equal FLIP", "time"]


def hair(count: int, middle: list[float]) -> mi.Mesh:
    """Bent hairs that stand off a point: each is a cross of two ribbons."""
    random = np.random.default_rng(1)
    t = np.linspace(0, 1, 9)[:, None]
    width = 0.0035 * (1 - 0.7 * t)
    vertices, faces = [], []
    for _ in range(count):
        along, across = random.normal(size=(2, 3))
        along /= np.linalg.norm(along)
        across -= (across @ along) * along
        across /= np.linalg.norm(across)
        line = np.array(middle) + along * (0.05 + 0.27 * t) + across * (0.08 * t * t)
        for normal in (across, np.cross(along, across)):
            first = 2 * 9 * len(vertices)
            vertices.append(np.stack([line - normal * width, line + normal * width], axis=1))
            k = first + 2 * np.arange(8)[:, None]
            faces += [k + [0, 1, 3], k + [0, 3, 2]]
    points, triangles = np.concatenate(vertices).reshape(-1, 3), np.concatenate(faces)
    brown = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.3, 0.2, 0.1]}}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": brown})
    mesh = mi.Mesh("hair", len(points), len(triangles), props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = points.ravel().astype(np.float32)
    parameters["faces"] = triangles.ravel().astype(np.uint32)
    parameters.update()
    return mesh


def hairball(size: tuple[int, int]) -> mi.Scene:
    """A hairball near the lens, a ball in focus, and a bright chequered sign far behind."""
    to = mi.ScalarTransform4f

    def rgb(*value: float) -> dict:
        return {"type": "rgb", "value": list(value)}

    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "pixel_format": "rgb",
            "rfilter": {"type": "gaussian"}}  # fmt: skip
    chequers = {"type": "checkerboard", "color0": rgb(1, 0.7, 0.25),
                "color1": rgb(0.02, 0.05, 0.15), "to_uv": to().scale([28, 16, 1])}  # fmt: skip
    # Connections to the sign would be noise of another kind than that of the lens
    sign = {"type": "area", "sampling_weight": 0.0, "radiance": chequers}
    return mi.load_dict({
        "type": "scene",
        "sensor": {"type": "thinlens", "fov": 40.0, "aperture_radius": 0.05, "focus_distance": 3.0,
                   "to_world": to().look_at(origin=[0, -3, 0], target=[0, 0, 0], up=[0, 0, 1]),
                   "film": film},
        "hair": hair(220, [0, -1.9, 0]),
        "ball": {"type": "sphere", "center": [0.55, 0, -0.2], "radius": 0.25,
                 "bsdf": {"type": "diffuse", "reflectance": rgb(0.1, 0.5, 0.2)}},
        "sign": {"type": "rectangle", "emitter": sign, "bsdf": {"type": "diffuse"},
                 "to_world": to().translate([0, 6, 0]).rotate([1, 0, 0], 90).scale([4, 2.2, 1])},
        "lamp": {"type": "rectangle", "emitter": {"type": "area", "radiance": 3.0},
                 "to_world": to().translate([0, -3, 3]).rotate([1, 0, 0], 150)},
    }, optimize=False)  # fmt: skip


def lamps(size: tuple[int, int]) -> mi.Scene:
    """A ball in focus on a street at night, and a hundred small lamps far behind it."""
    to, random = mi.ScalarTransform4f, np.random.default_rng(3)
    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "pixel_format": "rgb",
            "rfilter": {"type": "gaussian"}}  # fmt: skip

    def grey(value: float) -> dict:
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}

    scene = {
        "type": "scene",
        "sensor": {"type": "thinlens", "film": film, "fov": 40.0, "aperture_radius": 0.12,
                   "focus_distance": 2.5,
                   "to_world": to().look_at([0, -2.5, 0.8], [0, 0, 0.7], [0, 0, 1])},
        "ball": {"type": "sphere", "center": [0.2, 0, 0.5], "radius": 0.3, "bsdf": grey(0.6)},
        # Half of the connections: what is in focus is not to be the noise here
        "key": {"type": "rectangle",
                "emitter": {"type": "area", "radiance": 12.0, "sampling_weight": 100.0},
                "to_world": to().look_at([-2, -2, 3], [0, 0, 0.5], [0, 0, 1]).scale(0.3)},
        "street": {"type": "rectangle", "to_world": to().translate([0, 20, 0]).scale([20, 24, 1]),
                   "bsdf": grey(0.2)},
    }  # fmt: skip
    for i in range(100):
        place = [random.uniform(-9, 9), random.uniform(8, 30), random.uniform(0.3, 6)]
        color = np.array([1.0, 0.6, 0.2]) if i % 3 else np.array([0.2, 0.6, 1.0])
        light = {"type": "rgb", "value": (40 * color).tolist()}
        scene[f"lamp_{i}"] = {"type": "sphere", "center": place, "radius": 0.05,
                              "emitter": {"type": "area", "radiance": light}}  # fmt: skip
    return mi.load_dict(scene, optimize=False)


def with_lens(name: str, size: tuple[int, int]) -> mi.Scene:
    """A real scene whose sensor gets a lens."""
    file = REAL / name / "scene.xml"
    radius, focus = LENSES[name]
    lens = f'<float name="aperture_radius" value="{radius}"/>'
    lens += f'<float name="focus_distance" value="{focus}"/>'
    text = file.read_text()
    text = text.replace('<sensor type="perspective">', f'<sensor type="thinlens">{lens}')
    mi.file_resolver().prepend(str(file.parent))
    return mi.load_string(text, resx=str(size[0]), resy=str(size[1]), optimize=False)


def scene_of(name: str, size: tuple[int, int]) -> mi.Scene:
    if name in ("hairball", "lamps"):
        return {"hairball": hairball, "lamps": lamps}[name](size)
    return with_lens(name, size) if name in LENSES else load(name, size)


def ssim(image: np.ndarray, reference: np.ndarray) -> float:
    """Structural similarity (Wang et al., *Image Quality Assessment*, 2004) of luminances, after
    the gamma of a screen; windows are Gaussians of 1.5 pixels."""
    weights = np.array([0.2126, 0.7152, 0.0722])
    a, b = ((np.clip(x, 0, 1) ** (1 / 2.2)) @ weights for x in (image, reference))

    def mean(x: np.ndarray) -> np.ndarray:
        return gaussian_filter(x, 1.5, truncate=3.5)

    ma, mb = mean(a), mean(b)
    va, vb, covariance = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
    alike = (2 * ma * mb + 0.01**2) * (2 * covariance + 0.03**2)
    return float((alike / ((ma**2 + mb**2 + 0.01**2) * (va + vb + 0.03**2))).mean())


def timed(scene: mi.Scene, integrator: mi.Integrator, spp: int, seed: int):
    begin = time.process_time()
    image = mi.render(scene, integrator=integrator, spp=spp, seed=seed).numpy()
    return image.astype(np.float64), time.process_time() - begin


def reference_of(scene: mi.Scene, path: mi.Integrator, spp: int) -> np.ndarray:
    parts = [timed(scene, path, 64, 1000 + i)[0] for i in range(max(1, spp // 64))]
    return np.mean(parts, axis=0)


def samples_of_path(scene, path, reference, flip: float, most: int) -> int:
    """How many samples reach this FLIP: a power of 2; more than ``most`` are not tried."""
    spp = 1
    while spp < most and mean_flip(timed(scene, path, spp, 7)[0], reference) > flip:
        spp *= 2
    return spp


def save(folder: Path, name: str, images: list[np.ndarray]) -> None:
    height, width, _ = images[0].shape
    left, top, right, bottom = PARTS.get(name, (0, 0, 1, 1))
    rows, columns = slice(int(top * height), int(bottom * height)), slice(
        int(left * width), int(right * width)
    )
    parts = [image[rows, columns] for image in images]
    folder.mkdir(parents=True, exist_ok=True)
    for label, part in zip(("path", *FILTERS), parts):
        write(folder / f"{name}_{label}.jpg", part)
    parts += [np.ones_like(parts[0])] * (-len(parts) % 3)
    lines = [np.concatenate(parts[i : i + 3], axis=1) for i in range(0, len(parts), 3)]
    write(folder / f"{name}.png", np.repeat(np.repeat(np.concatenate(lines), 2, 0), 2, 1))


def write(file: Path, image: np.ndarray) -> None:
    mi.util.write_bitmap(str(file), mi.TensorXf(image.astype(np.float32)))
    mi.Thread.wait_for_tasks()


@click.command()
@click.option("--size", type=(int, int), default=(320, 180), help="Of the film.")
@click.option("--spp", default=64, help="Samples per pixel from the middle of the lens.")
@click.option("--reference-spp", default=4096)
@click.option("--max-depth", default=6)
@click.option("--pictures", default="out/defocus", help="Folder for pictures.")
@click.argument("names", nargs=-1, required=True)
def main(names, size, spp, reference_spp, max_depth, pictures) -> None:
    """Compares on the scenes NAMES: hairball, lamps, kitchen, sponza, or ours."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    print_header(COLUMNS)
    nested = {"type": "path", "max_depth": max_depth}
    path = mi.load_dict(nested)
    for name in names:
        scene = scene_of(name, size)
        reference = reference_of(scene, path, reference_spp)
        images = [reference]
        for filter in FILTERS:
            ours = mi.load_dict({"type": "ecoc_dof", "filter": filter, "nested": nested})
            timed(scene, ours, spp, 0)
            image, _ = timed(scene, ours, spp, 1)
            images.append(image)
            flip, rest = mean_flip(image, reference), ["", ""]
            if filter == "lens":
                equal = samples_of_path(scene, path, reference, flip, reference_spp)
                times = [(timed(scene, ours, spp, i)[1], timed(scene, path, equal, i)[1])
                         for i in (2, 3)]  # fmt: skip
                mine, theirs = np.min(times, axis=0)
                rest = [str(equal), f"{theirs / mine:.1f}"]
            print_row([name, filter, f"{flip:.4f}", f"{ssim(image, reference):.4f}", *rest])
        save(Path(pictures), name, images)
        dr.flush_malloc_cache()


if __name__ == "__main__":
    main()
