"""Draws paths over an image."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..scene.bounds import scene_bounds
from ..util.errors import InputError
from ..util.files import check_target, replacing
from .paths import PathVertex, PixelPaths, SamplePath

#: The formats of pictures.
FORMATS = (".png", ".jpg", ".svg", ".pdf")

_CAMERAS = ("PerspectiveCamera", "ThinLensCamera")

#: One for each path; they differ in brightness too.
_COLOURS = (
    "#ffd23f", "#3bceac", "#ee4266", "#4d9de0", "#f79256", "#c77dff", "#9ef01a", "#ffffff",
)  # fmt: skip

#: The least width of a picture, in pixels, and the resolution for which lines are made.
_LEAST_WIDTH, _DPI = 1000, 100


class Projection:
    """Projects points of the world into the image of a camera.

    Parameters:
        sensor: A ``perspective`` or a ``thinlens`` (whose pinhole is the centre of the lens).

    Raises:
        NotImplementedError: It is another sensor.
    """

    def __init__(self, sensor: mi.Sensor) -> None:
        if (kind := sensor.class_name()) not in _CAMERAS:
            raise NotImplementedError(
                f'paths cannot be drawn over the image of the sensor "{kind}", only over images of '
                f'"perspective" and "thinlens"'
            )
        film, values = sensor.film(), mi.traverse(sensor)
        self.size = np.array(film.crop_size())
        self._near = _first(values["near_clip"])
        to_sample = mi.perspective_projection(
            film.size(), film.crop_size(), film.crop_offset(), _first(values["x_fov"]),
            self._near, _first(values["far_clip"]),
        )  # fmt: skip
        self._to_camera = _matrix(sensor.world_transform().inverse())
        self._to_sample = _matrix(to_sample)
        point = [_first(values[f"principal_point_offset_{axis}"]) for axis in "xy"]
        self._shift = np.array(point) * np.array(film.size()) / self.size

    def line(self, p: Sequence[float], q: Sequence[float]) -> np.ndarray | None:
        """The line from ``p`` to ``q`` in pixels [2, 2], without its part behind the camera;
        ``None`` if nothing is left."""
        ends = [(self._to_camera @ [*point, 1])[:3] for point in (p, q)]
        for index in (0, 1):
            this, other = ends[index], ends[1 - index]
            if this[2] < self._near:
                if other[2] <= self._near:
                    return None
                share = (self._near - this[2]) / (other[2] - this[2])
                ends[index] = this + share * (other - this)
        found = []
        for point in ends:
            x, y, _z, w = self._to_sample @ [*point, 1]
            found.append((np.array([x, y]) / w - self._shift) * self.size)
        return np.array(found)


def check_picture(file: Path, sensor: mi.Sensor) -> None:
    """
    Raises:
        InputError: The picture cannot be written.
        NotImplementedError: See :class:`Projection`.
    """
    check_target(file)
    if file.suffix.lower() not in FORMATS:
        raise InputError(f"{file}: a picture of paths can be {', '.join(FORMATS)}")
    Projection(sensor)


def draw_paths(
    file: str | Path,
    image: np.ndarray,
    scene: mi.Scene,
    sensor: mi.Sensor,
    pixels: Sequence[PixelPaths],
) -> None:
    """Draws the paths of pixels over an image: a circle around each pixel, lines between vertices,
    and dashed lines to the lights to which vertices are connected.

    Parameters:
        file: The picture, a .png, .jpg, .svg or .pdf.
        image: Linear RGB [height, width, 3], of the size of the sensor's image.
        scene, sensor, pixels: What was replayed.

    Raises:
        NotImplementedError: The sensor is no ``perspective`` or ``thinlens``.
        InputError: The image has another size, or the file cannot be written.
    """
    # Not pyplot, which would change the user's figures and backend
    from matplotlib.figure import Figure

    check_picture(file := Path(file), sensor)
    projection = Projection(sensor)
    width, height = (int(n) for n in projection.size)
    if image.shape[:2] != (height, width):
        found = f"{image.shape[1]}x{image.shape[0]}"
        raise InputError(f"the image has {found} pixels, and the sensor {width}x{height}")
    wide = max(_LEAST_WIDTH, width) / _DPI
    figure = Figure(figsize=(wide, max(0.5, wide * height / width)), dpi=_DPI)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.imshow(_shown(image), extent=(0, width, height, 0), interpolation="nearest")
    axes.set(xlim=(0, width), ylim=(height, 0))
    bounds = scene_bounds(scene)
    far = 10 * float(np.linalg.norm(np.array(bounds.max) - np.array(bounds.min)))
    colours = iter(_COLOURS * (1 + sum(len(pixel.paths) for pixel in pixels) // len(_COLOURS)))
    for pixel in pixels:
        x, y = pixel.pixel
        ring = {"ms": 14, "mew": 1.5, "fillstyle": "none"}
        axes.plot([x + 0.5], [y + 0.5], "o", color="black", **{**ring, "mew": 3})
        axes.plot([x + 0.5], [y + 0.5], "o", color="white", **ring)
        for path, colour in zip(pixel.paths, colours):
            label = f"{x},{y}: {_named(path)}, {100 * path.share:.3g} %"
            axes.plot([], [], "-", color=colour, lw=2, label=label)
            for p, q, is_connection in _segments(path, far):
                line = projection.line(p, q)
                if line is None:
                    continue
                style = (0, (4, 3)) if is_connection else "solid"
                thin = 1.0 if is_connection else 1.6
                axes.plot(*line.T, linestyle=style, color="black", lw=thin + 1.4, alpha=0.6)
                axes.plot(*line.T, linestyle=style, color=colour, lw=thin)
                axes.plot(*line[1], "." if is_connection else "o", color=colour, ms=5, mec="black")
    if any(pixel.paths for pixel in pixels):
        axes.legend(loc="upper right", fontsize=10, framealpha=0.7)
    content = io.BytesIO()
    figure.savefig(content, format=file.suffix[1:].lower())
    with replacing(file) as temporary:
        temporary.write_bytes(content.getvalue())


def _segments(path: SamplePath, far: float) -> Iterator[tuple[np.ndarray, np.ndarray, bool]]:
    """The ends of each segment of a path, and of each connection to a light, which is marked by
    ``True``. An environment is ``far`` away."""
    before: PathVertex | None = None
    for vertex in path.vertices:
        place = np.array(vertex.position)
        if before is not None:
            start = np.array(before.position)
            if vertex.kind == "environment":
                place = start + far * place
            yield start, place, False
        for light in vertex.lights:
            if light.technique == "connection" and light.position is not None:
                end = np.array(light.position)
                yield place, place + far * end if light.is_infinite else end, True
        before = vertex


def _named(path: SamplePath) -> str:
    return "light path" if path.sample is None else f"sample {path.sample}"


def _shown(image: np.ndarray) -> np.ndarray:
    """The image as sRGB in [0, 1], somewhat darker, so that lines stand out."""
    linear = np.clip(np.nan_to_num(image[:, :, :3], posinf=1.0), 0, 1)
    return 0.8 * np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    )


def _matrix(transform: object) -> np.ndarray:
    return np.array(transform.matrix, dtype=np.float64).reshape(4, 4, -1)[:, :, 0]


def _first(value: object) -> float:
    return float(mi.Float(value)[0])
