"""The unfinished image of a render, and what is known of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

#: From CIE XYZ to linear sRGB.
_RGB_OF_XYZ = np.array(
    [[3.240479, -1.537150, -0.498535], [-0.969256, 1.875991, 0.041556],
     [0.055648, -0.204043, 1.057311]], dtype=np.float32,
)  # fmt: skip


@dataclass(frozen=True)
class Snapshot:
    """An image at some time of its render.

    Attributes:
        image: [height, width, channel], 32-bit floats.
        channels: The names of the channels: the film's image, then AOVs.
        image_channel_count: The number of channels of the film's image, alpha included.
        spp: Samples per pixel.
        seconds: The time of the render until then.
        variance: The variance of the first channels of ``image`` (without alpha), as far as it is
            known; otherwise ``None``.
        error: The relMSE, estimated from the variance, or measured; ``None`` if it is unknown.
        learned: Summary of what the integrator has learned.
        effects: What was chosen (:class:`~mitsuba_ext.rendering.statistics.RenderStatistics`).
        is_error_measured: Whether ``error`` was measured against a reference.
    """

    image: np.ndarray
    channels: tuple[str, ...]
    image_channel_count: int
    spp: int
    seconds: float = 0.0
    variance: np.ndarray | None = None
    error: float | None = None
    learned: str = ""
    effects: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    is_error_measured: bool = False

    def planes(self) -> dict[str, np.ndarray]:
        """All channels by name; ``variance.R`` and so on hold the variance."""
        found = {name: self.image[..., n] for n, name in enumerate(self.channels)}
        if self.variance is not None:
            for n in range(self.variance.shape[2]):
                found[f"variance.{self.channels[n]}"] = self.variance[..., n]
        return found

    def rgb(self) -> np.ndarray:
        """Linear RGB, [height, width, 3]. Films without colours show the mean of their channels."""
        return as_rgb(self.image, self.channels[: self.image_channel_count])

    def relative_deviation(self) -> np.ndarray | None:
        """The standard deviation of each pixel, relative to its brightness, [height, width]."""
        if self.variance is None:
            return None
        with np.errstate(invalid="ignore", divide="ignore"):
            deviation = np.sqrt(np.maximum(self.variance, 0).mean(axis=2))
            brightness = self.image[..., : self.variance.shape[2]].mean(axis=2)
            finite = brightness[np.isfinite(brightness)]
            floor = 1e-2 * float(np.abs(finite).mean()) if finite.size else 0.0
            return deviation / np.maximum(np.abs(brightness), max(floor, 1e-12))


def as_rgb(image: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Linear RGB of the image of a film, whose channels have these names."""
    if names[:3] == ("R", "G", "B"):
        return image[..., :3]
    if names[:3] == ("X", "Y", "Z"):
        return image[..., :3] @ _RGB_OF_XYZ.T
    colours = [n for n in range(len(names)) if names[n] != "A"]
    return np.repeat(image[..., colours].mean(axis=2, keepdims=True), 3, axis=2)
