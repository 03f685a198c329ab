"""Renders the references of the regression tests anew:

    python -m tests.support.regenerate_references [NAME …]

Do so only after an *intended* change of images, and look at the difference. Each reference holds,
for a film of 32 × 18 pixels, the mean and the variance of independent renders like the test's:

R, G, B                     mean
variance.R, .G, .B          variance of one render, per pixel
tile, image                 variance of the mean of the pixel's tile, and of the whole image
                            (the filter correlates neighbouring pixels, so these cannot be computed
                            from the variances of the pixels)
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import mitsuba_ext  # noqa: F401
from tests.support.paths import ROOT

import mitsuba as mi  # isort: skip

REFERENCES = ROOT / "tests" / "claims" / "references"
COMMAND = "python -m tests.support.regenerate_references"

TILE = 8
SEED_COUNT = 32
CHANNELS = ["R", "G", "B", "variance.R", "variance.G", "variance.B", "tile", "image"]


@dataclass(frozen=True)
class Regression:
    """An integrator on a scene that it is made for. ``is_slow``: not in ``make test``."""

    integrator: str
    scene: str
    parameters: dict[str, Any] = field(default_factory=dict)
    max_depth: int = 6
    spp: int = 128
    variant: str = "llvm_ad_rgb"
    is_slow: bool = False

    @property
    def name(self) -> str:
        return "_".join(map(str, [self.integrator, *self.parameters.values(), self.scene]))

    @property
    def reference(self) -> Path:
        return REFERENCES / f"{self.name}.exr"


REGRESSIONS = {
    regression.name: regression
    for regression in (
        Regression("composed_path", "cornell_box"),
        Regression("composed_path", "mirrors_and_glass"),
        Regression("composed_path", "sunny_gloss", max_depth=3),
        Regression("composed_path", "rooms", {"next_event": "spatial"}),
        Regression("composed_path", "rooms", {"next_event": "linear"}),
        Regression("composed_path", "rooms", {"next_event": "tree"}),
        Regression("neepp", "door_ajar"),
        Regression("neepp", "rooms"),
        Regression("neepp", "rooms", {"light_sampling": "visibility"}, spp=256, is_slow=True),
        Regression("neepp", "many_lamps", spp=384, is_slow=True),
        Regression("neepp", "window"),
        Regression("neepp", "open"),
        # Longer pilots than by default: the film is small
        Regression("pss_guided", "door_ajar", {"pilot_spp": 96}, spp=384),
        Regression("pss_guided", "door_ajar", {"pilot_spp": 96, "regions": "tiles", "tile": 8},
                   spp=384, is_slow=True),
        Regression("reweighted_direct", "cornell_box", {"light_samples": 16}, spp=32),
        Regression("two_stage", "window", {"light_samples": 4}, max_depth=3),
        Regression("composed_path", "portal_room", {"next_event": "portals"}, max_depth=3, spp=64),
        Regression("two_stage", "colonnade", {"light_samples": 4, "visibility": "primary"},
                   max_depth=2, spp=32),
        Regression("adaptive", "cornell_box", {"nested": "composed_path"}, spp=64),
        Regression("reweighted_lens", "defocus", {"nested": "path"}, spp=512),
        Regression("ecoc_dof", "defocus", {"nested": "path"}),
        Regression("reweighted_time", "fan", {"nested": "composed_path"}),
        Regression("composed_path", "fast_balls"),
        Regression("composed_path", "dunes"),
        Regression("composed_path", "lantern", max_depth=2, spp=512),
        Regression("swarm_path", "six_balls", {"always_use": True}, max_depth=2, spp=64),
        Regression("swarm_path", "peppers_ghost", {"always_use": True}, spp=1024, is_slow=True),
        Regression("swarm_path", "bounce_card", {"always_use": True, "direction_map": True},
                   max_depth=4, spp=512, is_slow=True),
        Regression("swarm_path", "showroom", {"always_use": True}, max_depth=3),
        Regression("swarm_path", "paperweight", {"always_use": True}, spp=256, is_slow=True),
        Regression("swarm_path", "discharge_lamps", {"always_use": True}, max_depth=4, spp=2048,
                   variant="llvm_ad_spectral", is_slow=True),
        Regression("composed_path", "near_lights", max_depth=4, is_slow=True),
        Regression("composed_path", "pool", {"caustics": "manifold"}, max_depth=8, is_slow=True),
        Regression("composed_path", "flint", variant="llvm_ad_spectral"),
        Regression("reweighted_wavelength", "prism", {"nested": "composed_path"},
                   variant="llvm_ad_spectral"),
        Regression("bdpt", "caustic", max_depth=3),
        Regression("bdpt", "corridor"),
        Regression("bdpt", "night_classroom"),
        Regression("light_tracer", "glass_lamp"),
        Regression("vcm", "pool", max_depth=8),
        Regression("sppm", "pool", max_depth=8, spp=256, is_slow=True),
        Regression("auto", "water_glass", max_depth=8, spp=2048, is_slow=True),
        Regression("photon_map", "pool", max_depth=8, spp=64, is_slow=True),
        Regression("instant_radiosity", "door_ajar", max_depth=4),
        Regression("irradiance_cache", "cornell_box", is_slow=True),
        Regression("pssmlt", "cornell_box", {"bidirectional": False, "chains": 1024}),
        Regression("erpt", "cornell_box", {"outliers": 2.0}),
        Regression("mlt", "cornell_box", {"chains": 1024}, is_slow=True),
    )
}  # fmt: skip


def render(regression: Regression, seeds: range) -> np.ndarray:
    """Images of independent seeds: [seed, height, width, channel]."""
    from tests.support.statistical import batches, load

    mi.set_variant(regression.variant)
    mi.set_log_level(mi.LogLevel.Warn)
    scene = load(regression.scene, width=32, height=18)
    integrator = {"type": regression.integrator, **regression.parameters}
    depth = {"max_depth": regression.max_depth}
    if "nested" in integrator:
        integrator["nested"] = {"type": integrator["nested"], **depth}
    else:
        integrator |= depth
    return batches(scene, mi.load_dict(integrator), regression.spp, seeds)


def regenerate(regression: Regression) -> None:
    images = render(regression, range(SEED_COUNT))
    height, width = images.shape[1:3]
    tile = np.empty((height, width, 1))
    for y in range(0, height, TILE):
        for x in range(0, width, TILE):
            part = images[:, y : y + TILE, x : x + TILE]
            tile[y : y + TILE, x : x + TILE] = part.mean(axis=(1, 2, 3)).var(ddof=1)
    image = np.full_like(tile, images.mean(axis=(1, 2, 3)).var(ddof=1))
    layers = [images.mean(axis=0), images.var(axis=0, ddof=1), tile, image]
    data = np.concatenate(layers, axis=2).astype(np.float32)
    bitmap = mi.Bitmap(data, mi.Bitmap.PixelFormat.MultiChannel, CHANNELS)
    REFERENCES.mkdir(exist_ok=True)
    bitmap.write(str(regression.reference))
    print(f"{regression.reference}: mean {images.mean():.5g} ± {image[0, 0, 0] ** 0.5:.2g}")


def main() -> None:
    unknown = set(sys.argv[1:]) - set(REGRESSIONS)
    if unknown:
        sys.exit(f"no such reference: {', '.join(unknown)}; there are {', '.join(REGRESSIONS)}")
    for name in sys.argv[1:] or REGRESSIONS:
        regenerate(REGRESSIONS[name])


if __name__ == "__main__":
    main()
