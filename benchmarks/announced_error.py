"""Is an image as good as ``render --until`` says?

    python benchmarks/announced_error.py

Renders scenes by ``path`` until their own batches announce an error, with several seeds, and
compares with the error against a reference, and with what would be announced if each pixel's own
brightness counted. Films are small, and batches short, so that few seconds
are enough, and bright spots matter.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import drjit as dr
import numpy as np

import mitsuba_ext  # noqa: F401
from mitsuba_ext.images import image_files, metrics
from mitsuba_ext.long_renders.batch_renderer import BatchRenderer, RenderRequest
from mitsuba_ext.long_renders.long_render import Goal, LongRender
from mitsuba_ext.long_renders.state import RenderState
from mitsuba_ext.rendering import seed_passes

import mitsuba as mi  # isort: skip

SCENES = Path(__file__).parents[1] / "scenes"
SIZE, BATCH_SPP, MOST_SPP = (48, 36), 16, 4096

#: Scenes, what renders their references, and errors to be reached.
CASES = [
    ("cornell_box", "path", 0.001),
    ("mirrors_and_glass", "path", 0.02),
    ("sunny_gloss", "path", 0.01),
    ("door_ajar", "pss_guided", 0.05),
    ("caustic", "bdpt", 0.1),
]


def rendered(scene: str, integrator: str, seed: int, goal: Goal) -> LongRender:
    file = str(SCENES / f"{scene}.xml")
    render = LongRender(BatchRenderer(RenderRequest(file, SIZE, (), integrator, seed=seed)),
                        RenderState())
    render.run(goal)
    return render


def rgb(render: LongRender) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance."""
    batches = render.state.images
    return tuple(image_files.to_rgb(x, batches.channels) for x in (batches.mean, batches.variance))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=[scene for scene, *_ in CASES])
    parser.add_argument("--seeds", type=int, default=16)
    parser.add_argument("--reference-spp", type=int, default=1 << 14)
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    print("| scene | until | spp | announced | true | true > 2 x announced | by own brightness |")
    print("|---|---|---|---|---|---|---|")
    for scene, integrator, error in CASES:
        if scene not in options.scenes:
            continue
        truth, variance = rgb(rendered(scene, integrator, 1 << 20, Goal(options.reference_spp)))
        before = dict(seed_passes._PASS_SAMPLES)
        seed_passes._PASS_SAMPLES[dr.JitBackend.LLVM] = SIZE[0] * SIZE[1] * BATCH_SPP
        found = []
        for seed in range(options.seeds):
            render = rendered(scene, "path", seed, Goal(MOST_SPP, error))
            image = rgb(render)
            true = metrics.relative_mse(image[0], truth, variance)
            own = metrics.reference_noise(*image)
            found.append((render.state.spp, render.error, true, own))
        seed_passes._PASS_SAMPLES.update(before)
        spp, announced, true, own = np.transpose(found)
        print(f"| {scene} | {error} | {np.median(spp):.0f} | {announced.mean():.2g} "
              f"| {true.mean():.2g} +- {true.std() / len(true) ** 0.5:.1g} "
              f"| {np.count_nonzero(true > 2 * announced)} of {len(true)} | {own.mean():.2g} |",
              flush=True)


if __name__ == "__main__":
    main()
