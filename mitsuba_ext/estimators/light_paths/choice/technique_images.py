"""An image of each technique of bidirectional path tracing."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ....images.image_files import write_exr
from ....transport.estimator import CameraRays
from ....util.arrays import channel_mean
from .candidates import Available
from .technique_observer import TechniqueObserver

#: Longest paths that the images show.
_MOST_SEGMENTS = 8

#: Words of a pixel of a technique: three colour channels, with and without MIS weights.
_WORDS = 6


def technique_number(s: int | mi.UInt32, t: int | mi.UInt32) -> int | mi.UInt32:
    """The index of a technique with s vertices on the light path and t ≥ 1 on the camera path.
    Techniques are ordered by path length, s + t − 1 segments, and then by s."""
    k = s + t - 1
    return (k - 1) * (k + 2) // 2 + s


class TechniqueImages(TechniqueObserver):
    """Adds up the contributions of each technique, with MIS weights and without.

    The images are unfiltered: a sample is added only to the pixel that it lies in. In spectral
    variants they show means over the wavelengths.

    Source: E. Veach, *Robust Monte Carlo Methods for Light Transport Simulation*, PhD thesis, 1997,
    Fig. 10.3.

    Parameters:
        film: Film of the sensor.
        width, height: Its sampled pixels.
        max_depth: Longest path in segments. Paths of more than 8 segments are left out, on large
            films shorter ones as well: :attr:`segments` is the length of the longest paths shown.
        most_bytes: Largest memory of the images.
    """

    def __init__(
        self, film: mi.Film, width: int, height: int, max_depth: int, most_bytes: int
    ) -> None:
        self._width, self._height = width, height
        self._offset = mi.Vector2f(mi.ScalarVector2f(film.crop_offset()))
        self._pixels = width * height
        segments = min(max_depth, _MOST_SEGMENTS)
        while segments > 1 and self._bytes(segments) > most_bytes:
            segments -= 1
        self.segments = segments
        self._sums = dr.zeros(mi.Float, self._bytes(segments) // 4)
        self._pixel, self._importance = mi.UInt32(0), mi.Spectrum(1)

    def _bytes(self, segments: int) -> int:
        return 4 * _WORDS * technique_number(0, segments + 2) * self._pixels

    # ---- Observer ----

    def start(self, rays: CameraRays, available: Available) -> None:
        self._pixel, self._importance = rays.pixel, rays.importance

    def emission(self, path, ds, value, mis, pdf, active) -> None:
        self._add_own(mi.UInt32(0), path.depth + 2, value, mis, active)

    def connection(
        self, choice, vertex, ds, contribution, value, pdf, visible, tested
    ) -> None:
        whole = channel_mean(vertex.path.β * contribution)
        mis = dr.select(whole != 0, channel_mean(value) / whole, 0)
        self._add_own(mi.UInt32(1), vertex.depth + 2, value, mis, visible)

    def joined(self, s, t, value, mis, competing, active) -> None:
        self._add_own(s, t, value, mis, active)

    def splatted(self, s, position, value, mis, competing, active) -> None:
        place = mi.Point2u(position - self._offset)
        pixel = place.y * self._width + place.x
        self._add(s, mi.UInt32(1), pixel, value, mis, active)

    def _add_own(self, s, t, value, mis, active) -> None:
        """Adds to the pixel of the camera path in the same lane."""
        self._add(s, t, self._pixel, value * self._importance, mis, active)

    def _add(self, s, t, pixel, value, mis, active) -> None:
        active = active & (s + t <= self.segments + 1) & (mis > 0)
        colour = mi.Color3f(value) if mi.is_rgb else mi.Color3f(channel_mean(value))
        place = _WORDS * (technique_number(s, t) * self._pixels + pixel)
        for channel in range(3):
            dr.scatter_add(self._sums, colour[channel], place + channel, active)
            dr.scatter_add(self._sums, colour[channel] / mis, place + channel + 3, active)

    # ---- After the render ----

    def images(self, spp: int) -> dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]:
        """For each technique (s, t) that found light: its image with and without MIS weights,
        [height, width, channel].

        Parameters:
            spp: Number of samples per pixel that were rendered.
        """
        count = technique_number(0, self.segments + 2)
        sums = self._sums.numpy().reshape(count, self._height, self._width, 2, 3) / spp
        found = {}
        for k in range(1, self.segments + 1):
            for s in range(k + 1):
                image = sums[technique_number(s, k + 1 - s)]
                if image.any():
                    found[s, k + 1 - s] = (image[:, :, 0], image[:, :, 1])
        return found

    def write(self, file: Path, spp: int) -> None:
        """Writes all images into one OpenEXR file: layers ``weighted.s1_t2``, ``plain.s1_t2``."""
        names, channels = [], []
        for (s, t), images in self.images(spp).items():
            for kind, image in zip(("weighted", "plain"), images):
                names += [f"{kind}.s{s}_t{t}.{colour}" for colour in "RGB"]
                channels.append(image)
        if not channels:
            names, channels = list("RGB"), [np.zeros((self._height, self._width, 3))]
        pixels = np.ascontiguousarray(np.concatenate(channels, axis=2), dtype=np.float32)
        write_exr(file, pixels, names, {})
