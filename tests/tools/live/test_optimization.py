"""Progress and plots of optimizations."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("variant")


def test_loss_noise_and_images_are_recorded_and_drawn(capsys) -> None:
    from mitsuba_ext.live.optimization import OptimizationProgress

    optimizer = mi.ad.Adam(lr=0.01)
    optimizer["scale"], optimizer["texture"] = mi.Float(2), mi.TensorXf(np.ones((2, 3, 3)))
    progress = OptimizationProgress(optimizer, 40)
    random = np.random.default_rng(1)
    seen = []
    for step in progress:
        seen.append(step)
        # The gradient has the mean 1 and the standard deviation 0.5
        weights = mi.TensorXf(random.normal(1, 0.5, (2, 3, 3)).astype(np.float32))
        image = optimizer["texture"] * weights
        dr.backward(dr.sum(image, axis=None))
        progress.add(dr.mean(image, axis=None), image)
        optimizer.step()
    assert seen == list(range(40)) and len(progress.losses) == len(progress.seconds) == 40
    assert progress.losses[-1] == pytest.approx(float(np.mean(progress.image.numpy())), rel=1e-4)
    # One step alone has no noise, except of rounding
    assert np.isnan(progress.noises[0]) and np.isfinite(progress.noises[1:]).all()
    assert 0.35 < np.mean(progress.noises[-20:]) < 0.6
    assert "40/40" in capsys.readouterr().out
    figure = progress.plot()
    assert [axis.get_title() for axis in figure.axes] == [
        "loss", "noise of the gradients", "first image", "last image"
    ]  # fmt: skip
    assert progress._repr_png_().startswith(b"\x89PNG")


def test_an_optimization_without_steps_or_images() -> None:
    from mitsuba_ext.live.optimization import OptimizationProgress

    optimizer = mi.ad.Adam(lr=0.01)
    optimizer["x"] = mi.Float(1)
    with pytest.raises(ValueError, match='"steps" is 0'):
        OptimizationProgress(optimizer, 0)
    progress = OptimizationProgress(optimizer, 4, quiet=True)
    assert progress._repr_png_().startswith(b"\x89PNG")
    for step in progress:
        before = dr.detail.launch_stats()
        progress.add(0.0)  # no gradient
        # From the second step on, no kernel is new
        assert step < 2 or dr.detail.launch_stats()[1:] == before[1:]
    assert np.isnan(progress.noises).all() and len(progress.plot().axes) == 2
    for channels in (1, 4, 7):
        progress.add(1.0, mi.TensorXf(np.ones((2, 3, channels))))
        assert len(progress.plot().axes) == 4
        assert progress._repr_png_().startswith(b"\x89PNG")
