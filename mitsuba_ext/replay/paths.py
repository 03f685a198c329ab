"""The paths of a pixel, as :func:`mitsuba_ext.replay.replay` returns them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

#: Numbers of a vector, such as a position or a colour.
Numbers = tuple[float, ...]


@dataclass(frozen=True)
class FoundLight:
    """Light that a path gains at a vertex.

    Attributes:
        technique: How it was found: ``emission`` (the path hits the light), ``connection`` (to a
            point on a light), ``light path`` (a connection to the end of a light path), ``merge``
            (with a light path that ends close to the vertex), ``light image`` (a light path reaches
            the sensor), or ``other`` (what the integrator adds without saying where, such as
            interpolated irradiance, or takes away, as a clamp does).
        light: The light; empty if it is unknown.
        position: The point on the light, or the direction towards it if it is infinitely far away.
            ``None`` if it is unknown.
        is_infinite: Whether the light is infinitely far away.
        pdf: The density, in solid angle at the previous vertex (``emission``) or at this one
            (``connection``), with which this technique finds the light. ``None`` if it is unknown.
        other_pdf: The density with which the other of these two techniques finds it.
        mis: The MIS weight, divided by the number of connections if there are several, and by the
            probability with which a shadow ray is traced; ``None`` if it is unknown.
        light_vertices: For ``light path``: the number of vertices of the light path.
        radiance: What the sample gains, as linear RGB: throughput and MIS weight are included.
    """

    technique: str
    radiance: Numbers
    light: str = ""
    position: Numbers | None = None
    is_infinite: bool = False
    pdf: float | None = None
    other_pdf: float | None = None
    mis: float | None = None
    light_vertices: int | None = None


@dataclass(frozen=True)
class PathVertex:
    """A vertex of a camera path.

    Attributes:
        kind: ``surface``, ``medium`` or ``environment``.
        position: The position in the world; of an environment, the direction towards it.
        normal: The shading normal of a surface; ``None`` elsewhere.
        shape, bsdf: The names of shape and BSDF; empty if there is none.
        event: What the path does there, such as ``diffuse reflection`` or ``delta transmission``;
            ``end`` at its last vertex.
        throughput: The throughput of the path up to the vertex, one number for each channel of
            the spectrum (in spectral variants, for each wavelength).
        pdf: The density of the direction in which the path goes on, in solid angle; ``None`` at the
            last vertex. For delta lobes, the probability of the lobe.
        survival: The probability of Russian roulette behind the vertex; 1 if there was none.
        lights: The light that the path gains at the vertex.
    """

    kind: str
    position: Numbers
    normal: Numbers | None
    shape: str
    bsdf: str
    event: str
    throughput: Numbers
    pdf: float | None
    survival: float = 1.0
    lights: tuple[FoundLight, ...] = ()


@dataclass(frozen=True)
class SamplePath:
    """A sample of a pixel.

    Attributes:
        sample: The number of the sample in its pixel, counted over the render; ``None`` for a light
            path that reaches the sensor.
        stage: The stage of the render that took it, counted from 0: pilots come before the last.
        radiance: Its radiance, as linear RGB.
        contribution: What it adds to the pixel: its radiance, times its weight over the sum of the
            weights of all samples.
        share: The share of the brightness of the pixel.
        wavelengths: The wavelengths in nanometres; empty in RGB variants.
        vertices: The vertices, beginning with the first that the camera sees.
        lights: Light that belongs to no vertex.
    """

    sample: int | None
    stage: int
    radiance: Numbers
    contribution: Numbers
    share: float
    wavelengths: Numbers
    vertices: tuple[PathVertex, ...]
    lights: tuple[FoundLight, ...] = ()


@dataclass(frozen=True)
class PixelPaths:
    """The brightest samples of a pixel.

    Attributes:
        pixel: Column and row of the pixel in the image, counted from the upper left corner.
        value: The mean of all samples that begin in the pixel, and of the light paths that reach
            it, as linear RGB. With a box filter it is the value of the pixel in the image. Wider
            filters add samples of the neighbours.
        spp: The number of samples.
        contributions: What each sample adds to the value, the brightest first [number, 3].
        paths: The brightest samples, the brightest first.
    """

    pixel: tuple[int, int]
    value: Numbers
    spp: int
    contributions: np.ndarray = field(repr=False)
    paths: tuple[SamplePath, ...] = field(repr=False)

    def as_dict(self) -> dict[str, Any]:
        """Everything except the array of contributions, for JSON."""
        shown = {name: getattr(self, name) for name in ("pixel", "value", "spp")}
        return {**shown, "paths": [asdict(path) for path in self.paths]}


def brightest_first(rgb: np.ndarray) -> np.ndarray:
    """The order of these colours [number, 3] by brightness; NaN comes first."""
    brightness = np.abs(luminance(rgb))
    return np.argsort(-np.where(np.isnan(brightness), np.inf, brightness), kind="stable")


def luminance(rgb: np.ndarray) -> np.ndarray:
    """The luminance of linear RGB, in the last axis."""
    return rgb @ np.array([0.212671, 0.715160, 0.072169])
