"""The parameter ``checkpoint`` of our integrators."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.long_renders.folder import CheckpointFolder

pytestmark = pytest.mark.usefixtures("batches_of_sixteen_samples")

#: One of each way to render, with less than its defaults do.
INTEGRATORS = {
    "neepp": {"pilot_spp": 4},
    "bdpt": {},
    "pssmlt": {"direct_samples": 4, "chains": 64, "luminance_samples": 1024},
    "adaptive": {"nested": {"type": "path", "max_depth": 3}},
    "reweighted_lens": {"nested": {"type": "composed_path", "max_depth": 3}},
    "ecoc_dof": {"nested": {"type": "path", "max_depth": 3}, "aperture_radius": 0.1,
                 "focus_distance": 5.0},
}  # fmt: skip


@pytest.fixture
def scene(make_scene):
    """Loads the scene anew, as another process does."""
    return lambda: mi.load_file(str(make_scene()))


def integrator(name: str = "composed_path", **parameters) -> mi.Integrator:
    return mi.load_dict({"type": name, **INTEGRATORS.get(name, {}), **parameters})


@pytest.mark.parametrize("name", [
    "composed_path", "neepp", "adaptive", "reweighted_lens",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("bdpt", "pssmlt", "ecoc_dof")),
])  # fmt: skip
def test_a_render_continues_where_it_ended(name, scene, tmp_path):
    folder = str(tmp_path / "kept")
    first, second = (integrator(name, checkpoint=folder) for _ in range(2))
    half = np.array(mi.render(scene(), integrator=first, spp=32, seed=3))
    assert first.statistics.spp == 32 and not first.statistics.interrupted
    image = np.array(mi.render(scene(), integrator=second, spp=64, seed=3))
    state = CheckpointFolder(tmp_path / "kept").load()
    assert second.statistics.spp == state.spp == 64 and len(state.done) == 4
    assert image.shape == half.shape and not np.array_equal(image, half)
    # No other folder: the nested integrator has none
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["kept"]
    other = integrator(name, checkpoint=str(tmp_path / "whole"))
    whole = np.array(mi.render(scene(), integrator=other, spp=64, seed=3))
    tolerance = 0.05 if name in ("pssmlt", "neepp") else 1e-4
    np.testing.assert_allclose(image.mean(), whole.mean(), rtol=tolerance)
    # Nothing is left to do
    again = integrator(name, checkpoint=folder)
    np.testing.assert_allclose(
        np.array(mi.render(scene(), integrator=again, spp=64, seed=3)), image, rtol=1e-6)


def test_another_render_is_refused(scene, make_scene, tmp_path):
    folder = str(tmp_path / "kept")
    mi.render(scene(), integrator=integrator(checkpoint=folder), spp=16)

    def refused(words: str, loaded: mi.Scene, seed: int = 0, **parameters) -> None:
        kept = integrator(checkpoint=folder, **parameters)
        with pytest.raises(ValueError, match=f"kept: holds another render: {words}"):
            kept.render(loaded, seed=seed, spp=16)

    refused('"seed" differs', scene(), seed=1)
    refused('"parameters" differs', scene(), max_depth=2)
    other = scene()
    parameters = mi.traverse(other)
    key = next(key for key in parameters.keys() if "reflectance" in key)
    parameters[key] = 0.1
    parameters.update()
    refused('"scene" differs', other)
    # A time limit is none of the image's parameters
    mi.render(scene(), integrator=integrator(checkpoint=folder, timeout=60.0), spp=16)


def test_choices_that_are_no_parameters_are_seen(make_scene, tmp_path):
    def metal(distribution: str) -> mi.Scene:
        bsdf = f'<bsdf type="roughconductor"><string name="distribution" value="{distribution}"/>'
        return mi.load_file(str(make_scene(body=f'<shape type="sphere">{bsdf}</bsdf></shape>')))

    kept = integrator(checkpoint=str(tmp_path / "kept"))
    kept.render(metal("ggx"), spp=1)
    with pytest.raises(ValueError, match='holds another render: "scene" differs'):
        kept.render(metal("beckmann"), spp=2)
    kept.render(metal("ggx"), spp=2)


def test_it_can_be_cancelled_and_interrupted(scene, tmp_path):
    kept = integrator(checkpoint=str(tmp_path / "kept"))
    seen = []

    def progress(done: float) -> None:
        seen.append(done)
        if len(seen) == 2:
            kept.cancel()

    kept.progress = progress
    kept.render(scene(), spp=64)
    assert seen == [0.25, 0.5] and kept.statistics.spp == 32 and kept.statistics.interrupted

    def interrupt(done: float) -> None:
        raise KeyboardInterrupt

    kept.progress = interrupt
    with pytest.raises(KeyboardInterrupt):
        kept.render(scene(), spp=64)
    assert CheckpointFolder(tmp_path / "kept").load().spp == 48
    kept.progress = None
    kept.render(scene(), spp=64)
    assert kept.statistics.spp == 64 and not kept.statistics.interrupted


@pytest.mark.parametrize(("parameters", "words"), [
    ({"type": "composed_path", "checkpoint": "a", "checkpoint_every": "5"}, "something like 60s"),
    ({"type": "composed_path", "checkpoint_every": "5s"}, "checkpoint_every"),
    ({"type": "pssmlt", "checkpoint": "a", "chain_file": "b"}, "exclude each other"),
    ({"type": "bdpt", "checkpoint": "a", "technique_images": "b.exr"}, "exclude each other"),
    ({"type": "adaptive", "nested": {"type": "neepp", "checkpoint": "a"}}, "outermost integrator"),
    ({"type": "variance", "nested": {"type": "neepp", "checkpoint": "a"}}, "outermost integrator"),
])  # fmt: skip
def test_integrators_that_cannot_be_kept_are_named(parameters, words):
    with pytest.raises(RuntimeError, match=words):
        mi.load_dict(parameters)


def test_other_ways_to_keep_or_measure_it_are_refused(run, make_scene, scene, tmp_path):
    xml = '<integrator type="composed_path"><string name="checkpoint" value="a"/></integrator>'
    path = make_scene(integrator=xml)
    code, _, err = run("render", path, "-o", tmp_path / "a.exr", "--checkpoint", tmp_path / "b")
    assert code == 2 and '"checkpoint" already saves the render' in err
    code, _, err = run("render", path, "-o", tmp_path / "a.exr", "--time", 1)
    assert code == 2 and "--time would measure" in err
    kept = "neepp:checkpoint=a"
    code, _, err = run("compare", path, "path", kept, "--spp", 1, "--out", tmp_path / "out")
    assert code == 2 and '"checkpoint", with which it does not render everything' in err
    moment = mi.load_dict({"type": "moment", "nested": integrator(checkpoint="a")})
    with pytest.raises((ValueError, RuntimeError), match="another integrator draws the samples"):
        moment.render(scene(), spp=1)
