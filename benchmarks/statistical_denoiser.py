"""A denoiser without a network, beside Open Image Denoise: H. Sakai, C. Freude, T. Auzinger, D.
Hahn, M. Wimmer, *A Statistical Approach to Monte Carlo Denoising*, SIGGRAPH Asia 2024.

    python benchmarks/statistical_denoiser.py mirrors_and_glass SCENES/kitchen/scene.xml

A pixel becomes the mean of those neighbours from which a t-test does not tell it apart, in each
channel, weighted by distance, albedo and normal. The test takes the moments of transformed samples
y = 2 √x (Box-Cox, λ = 1/2), and corrects their mean for skewness (Johnson 1978). ``path`` renders
the samples, one image for each. The table has FLIP, and relMSE in brackets; scenes and references
are the same as in ``denoiser_guides.py``.
"""

from __future__ import annotations

from dataclasses import dataclass

import click
import numpy as np
from denoiser_guides import images, reference_of
from equal_samples import load, title
from scipy.stats import t as student

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)
from mitsuba_ext.images.denoising import denoise
from mitsuba_ext.images.metrics import errors

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

#: Standard deviations of the weights by albedo and by normal, and the radius in pixels.
_ALBEDO, _NORMAL, _RADIUS = 0.02, 0.1, 20

#: The significance of the test, and the standard deviation of the weights by distance, in pixels:
#: of the authors, whose images are four times as wide, and the best that we found.
SETTINGS = {"authors'": (0.005, 10.0), "tuned": (0.05, 5.0)}


@dataclass
class Moments:
    """Sums of the samples of each pixel and channel: arrays (height, width, 3), in double
    precision.

    Attributes:
        count: Number of samples.
        x: The sum of the samples.
        y: The sums of the first three powers of the transformed samples.
    """

    count: int
    x: np.ndarray
    y: list[np.ndarray]

    @classmethod
    def none(cls, shape: tuple[int, ...]) -> Moments:
        return cls(0, np.zeros(shape), [np.zeros(shape) for _ in range(3)])

    def add(self, sample: np.ndarray) -> None:
        y = 2 * np.sqrt(sample)
        self.count += 1
        self.x += sample
        for power, total in enumerate(self.y):
            total += y ** (power + 1)

    def mean(self) -> np.ndarray:
        return (self.x / self.count).astype(np.float32)

    def tested(self) -> tuple[np.ndarray, np.ndarray]:
        """The mean of the transformed samples, corrected for skewness, and its variance."""
        n, (y, y2, y3) = self.count, self.y
        mean = y / n
        variance = np.maximum(y2 - n * mean**2, 0) / (n - 1)
        third = y3 / n - 3 * mean * y2 / n + 2 * mean**3
        skewness = np.where(variance > 1e-7, third / (6 * n * np.maximum(variance, 1e-7)), 0)
        return mean + skewness, variance / n


def denoised(
    moments: Moments, albedo: np.ndarray, normal: np.ndarray, significance: float, deviation: float
) -> np.ndarray:
    """The image without noise, (height, width, 3)."""
    height, width = moments.x.shape[:2]
    mean, variance = moments.tested()
    arrays = [
        _flat(array)
        for array in (moments.mean(), mean, variance, albedo / _ALBEDO, normal / _NORMAL)
    ]
    limit = student.ppf(1 - significance / 2, 2 * moments.count - 2) ** 2
    size = mi.Int32(dr.opaque(mi.Int32, width)), mi.Int32(dr.opaque(mi.Int32, height))
    pixels = dr.arange(mi.Int32, width * height)
    found = _filtered(pixels, size, arrays, dr.opaque(mi.Float, limit), dr.rcp(deviation))
    return np.array(found).T.reshape(height, width, 3)


@dr.syntax
def _filtered(pixel, size, arrays, limit, scale):
    width, height = size
    color, mean, variance, albedo, normal = arrays
    y = pixel // width
    x = pixel - y * width
    own = [dr.gather(mi.Vector3f, array, pixel) for array in (mean, variance, albedo, normal)]
    total, weights = mi.Vector3f(0), mi.Float(0)
    down, right = mi.Int32(-_RADIUS), mi.Int32(-_RADIUS)
    while down <= _RADIUS:
        inside = (x + right >= 0) & (x + right < width) & (y + down >= 0) & (y + down < height)
        other = pixel + dr.select(inside, down * width + right, 0)
        squared = dr.square(own[0] - dr.gather(mi.Vector3f, mean, other))
        is_alike = squared <= limit * (own[1] + dr.gather(mi.Vector3f, variance, other))
        far = dr.square(scale) * mi.Float(down * down + right * right)
        far += dr.squared_norm(own[2] - dr.gather(mi.Vector3f, albedo, other))
        far += dr.squared_norm(own[3] - dr.gather(mi.Vector3f, normal, other))
        weight = dr.select(inside & dr.all(is_alike), dr.exp(-0.5 * far), 0)
        total += weight * dr.gather(mi.Vector3f, color, other)
        weights += weight
        is_last = right == _RADIUS
        down += dr.select(is_last, 1, 0)
        right = dr.select(is_last, -_RADIUS, right + 1)
    return total / weights  # a pixel is like itself


def _flat(array: np.ndarray) -> mi.Float:
    return mi.Float(np.ascontiguousarray(array, dtype=np.float32).ravel())


@click.command()
@click.argument("scenes", nargs=-1, required=True)
@click.option("--spp", default="16,64,256", show_default=True)
def main(scenes: tuple[str, ...], spp: str) -> None:
    """Compares on SCENES."""
    mi.set_variant("llvm_ad_rgb")
    counts = [int(count) for count in spp.split(",")]
    columns = ("image", "Open Image Denoise", *SETTINGS)
    print(f"| scene | spp | {' | '.join(columns)} |\n|---|---|{'---|' * len(columns)}", flush=True)
    for name in scenes:
        reference, size, max_depth = reference_of(name)
        scene = load(name, size)
        guides = images(scene)
        integrator = mi.load_dict({"type": "path", "max_depth": max_depth})
        moments = Moments.none((size[1], size[0], 3))
        while moments.count < max(counts):
            # Neighbouring seeds would do: the sampler is "independent"
            image = mi.render(scene, integrator=integrator, spp=1, seed=1000 + moments.count)
            moments.add(np.array(image)[..., :3].astype(np.float64))
            if moments.count not in counts:
                continue
            mean = moments.mean()
            found = [mean, denoise(mean, *guides)]
            found += [denoised(moments, *guides, *setting) for setting in SETTINGS.values()]
            cells = []
            for result in found:
                e = errors(result, reference.mean, reference.variance)
                cells.append(f"{e.flip:.3f} ({e.relmse:.2g})")
            print(f"| {title(name)} | {moments.count} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
