"""The images of single techniques of ``bdpt``."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from tests.support.emitters_and_materials import T, below_the_lamp
from tests.support.stage import area, diffuse, film, rectangle, stage
from tests.support.statistical import MANY_SEEDS, REFERENCE_SEEDS, SEEDS, THRESHOLD, z_welch

pytestmark = pytest.mark.usefixtures("variant")


def _scene() -> mi.Scene:
    """A large lamp, which camera paths run into often."""
    lamp = rectangle(T().translate([0, 0, 2.5]).rotate([1, 0, 0], 180).scale(1.5),
                     emitter=area(1.0), bsdf=diffuse(0.0))  # fmt: skip
    camera = below_the_lamp(film=film(12, 12, rfilter={"type": "box"}))
    return mi.load_dict(stage(light=lamp, camera=camera), optimize=False)


def _render(scene: mi.Scene, seed: int, spp: int = 64, **parameters):
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 4, **parameters})
    image = np.array(integrator.render(scene, seed=seed, spp=spp))
    return image[..., :3], integrator


def test_weighted_images_add_up_to_the_image(tmp_path: Path) -> None:
    image, integrator = _render(_scene(), 1, technique_images=str(tmp_path / "all.exr"))
    by_technique = integrator.techniques.images(64)
    # The camera does not see the lamp
    assert set(by_technique) == {(s, k + 1 - s) for k in (2, 3, 4) for s in range(k + 1)}
    total = sum(weighted for weighted, _plain in by_technique.values())
    np.testing.assert_allclose(total, image, rtol=1e-4, atol=1e-5)


def test_the_file_has_a_layer_for_each_image(tmp_path: Path) -> None:
    file = tmp_path / "all.exr"
    image, _ = _render(_scene(), 1, technique_images=str(file))
    layers = {k: np.array(v) for k, v in mi.Bitmap(str(file)).split()}
    total = sum(v for k, v in layers.items() if k.startswith("weighted."))
    assert {"weighted.s1_t2", "plain.s3_t1"} <= set(layers)
    np.testing.assert_allclose(total, image, rtol=1e-4, atol=1e-5)


def test_images_do_not_change_the_render(tmp_path: Path) -> None:
    scene = _scene()
    with_images, _ = _render(scene, 3, technique_images=str(tmp_path / "all.exr"))
    np.testing.assert_allclose(with_images, _render(scene, 3)[0], rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_each_technique_finds_all_paths_of_a_length(tmp_path: Path) -> None:
    """Without weights: in this scene, each technique can make every path. Together, with weights,
    they make the image of ``path`` (``test_bdpt.py``)."""
    scene, file = _scene(), str(tmp_path / "all.exr")

    def means(seeds: range) -> dict[tuple[int, int], np.ndarray]:
        """The means of each technique: [seed, weighted or plain]."""
        found: dict[tuple[int, int], list] = {}
        for seed in seeds:
            _, integrator = _render(scene, seed, 512, technique_images=file)
            for technique, images in integrator.techniques.images(512).items():
                found.setdefault(technique, []).append([image.mean() for image in images])
        return {technique: np.array(values) for technique, values in found.items()}

    found, others = means(SEEDS[:MANY_SEEDS]), means(REFERENCE_SEEDS[:MANY_SEEDS])
    for k in (2, 3, 4):
        expected = sum(others[s, k + 1 - s][:, 0] for s in range(k + 1))
        for s in range(k + 1):
            plain = found[s, k + 1 - s][:, 1]
            z = float(z_welch(plain[:, None], expected[:, None])[0])
            assert abs(z) < THRESHOLD, (s, k + 1 - s, plain.mean() / expected.mean())
            error = np.hypot(*(x.std() / len(x) ** 0.5 for x in (plain, expected)))
            # Vertices that are joined may be close to each other: such values are rare and large
            assert error < 0.1 * expected.mean(), (s, k + 1 - s, "known badly")


def test_parameters_that_cannot_be_combined_with_them_are_refused(tmp_path: Path) -> None:
    for parameters in (
        {"technique_images": str(tmp_path / "a.exr"), "light_paths": "auto"},
        {"sample_direct": False, "next_event": "power"},
    ):
        with pytest.raises((ValueError, RuntimeError), match="cannot be combined with"):
            mi.load_dict({"type": "bdpt", **parameters})


def test_another_kind_of_file_is_refused() -> None:
    with pytest.raises((ValueError, RuntimeError), match="must end with"):
        mi.load_dict({"type": "bdpt", "technique_images": "a.png"})


def test_without_lights_no_file_is_written(tmp_path: Path) -> None:
    file = tmp_path / "a.exr"
    scene = mi.load_dict(stage(light={}))
    image, _ = _render(scene, 1, 1, technique_images=str(file), subpath_selection="visibility")
    assert not image.any() and not file.exists()


def test_a_file_that_cannot_be_written_is_named_before_the_render(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="technique_images"):
        _render(_scene(), 1, 1, technique_images=str(tmp_path / "nowhere" / "a.exr"))
