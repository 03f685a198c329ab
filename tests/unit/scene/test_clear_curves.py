"""No ray hits a curve from inside. Light that passes through hair is left to camera paths, and
refused by methods that need light paths to find it."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Any

import mitsuba as mi
import pytest

from mitsuba_ext.scene.bsdfs import has_clear_curves
from tests.support.stage import diffuse, film, lookat, sensor
from tests.support.statistical import (
    MANY_SEEDS,
    REFERENCE_SEEDS,
    SEEDS,
    assert_same_quarters,
    batches,
    some,
)

pytestmark = pytest.mark.usefixtures("variant")


def _strands(folder: Path, bsdf: dict[str, Any], shape: str = "bsplinecurve") -> mi.Scene:
    """Two thick strands in front of a lamp."""
    strands = ("\n".join(f"{x} 0 {z} 0.3" for x in range(-3, 4)) for z in (0.1, 0.9))
    (folder / "strands.txt").write_text("\n\n".join(strands))
    view = lookat([0, -4, 0.5], [0, 0, 0.5], [0, 0, 1])
    return mi.load_dict({
        "type": "scene", "sensor": sensor(film=film(16, 16), to_world=view, fov=18.0),
        "strands": {"type": shape, "filename": str(folder / "strands.txt"), "bsdf": bsdf},
        "lamp": {"type": "point", "position": [0, 0.8, 0.5], "intensity": 6.0},
    }, optimize=False)  # fmt: skip


_HAIR = {"type": "hair", "longitudinal_roughness": 0.4, "azimuthal_roughness": 0.4}


@pytest.mark.parametrize(("integrator", "shape"), some(
    ("bdpt", "bsplinecurve"),
    of=[("bdpt", "bsplinecurve"), ("bdpt", "linearcurve"), ("vcm", "bsplinecurve"),
        ("pssmlt", "bsplinecurve")],
))  # fmt: skip
def test_light_passes_through_hair_as_in_path(integrator: str, shape: str, tmp_path: Path) -> None:
    scene = _strands(tmp_path, _HAIR, shape)
    ours, path = (mi.load_dict({"type": x, "max_depth": 4}) for x in (integrator, "path"))
    images = batches(scene, ours, 128, SEEDS[:MANY_SEEDS])
    expected = batches(scene, path, 512, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, 0.01)


@pytest.mark.parametrize(
    "integrator", ["light_tracer", "sppm", "photon_map", "instant_radiosity", "mlt"]
)
def test_hair_is_refused_where_only_light_paths_would_find_its_light(
    integrator: str, tmp_path: Path
) -> None:
    ours = mi.load_dict({"type": integrator, "max_depth": 4})
    with pytest.raises(NotImplementedError, match=f'"{integrator}": light paths do not pass.*hair'):
        ours.render(_strands(tmp_path, _HAIR), spp=1)


def test_hair_in_an_instance_is_found(tmp_path: Path) -> None:
    strand = tmp_path / "strand.txt"
    strand.write_text("\n".join(f"{x} 0 0 0.3" for x in range(-3, 4)))
    for bsdf, is_clear in ((diffuse(), False), (_HAIR, True)):
        scene = mi.load_dict({
            "type": "scene",
            "group": {"type": "shapegroup", "strand": {
                "type": "bsplinecurve", "filename": str(strand), "bsdf": bsdf,
            }},
            "instance": {"type": "instance", "group": {"type": "ref", "id": "group"}},
        })  # fmt: skip
        gc.collect()
        assert has_clear_curves(scene) == is_clear


def test_opaque_curves_are_not_refused(tmp_path: Path) -> None:
    light_tracer = mi.load_dict({"type": "light_tracer", "max_depth": 3})
    assert light_tracer.render(_strands(tmp_path, diffuse()), spp=1).numpy().any()
