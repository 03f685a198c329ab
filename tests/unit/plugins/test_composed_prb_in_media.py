"""The gradients of ``composed_prb`` in participating media."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.transport import replay
from tests.support.fogs import LIGHTS, cube, fog, fog_around_the_camera, homogeneous
from tests.support.stage import area, film, lookat, rectangle, sensor

pytestmark = pytest.mark.usefixtures("variant")

#: The number of values of a grid.
_SHAPE = (3, 4, 5, 1)


def make(name: str = "composed_prb", **parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": name, "max_depth": 4, "rr_depth": 50, **parameters})


def cloud(density: np.ndarray, albedo: Any = 0.9) -> dict[str, Any]:
    """A medium in the cube from −1 to 1."""
    to_world = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    grid = mi.VolumeGrid(density.astype(np.float32))
    volume = {"type": "gridvolume", "grid": grid, "to_world": to_world, "filter_type": "nearest"}
    return {"type": "heterogeneous", "albedo": albedo, "sigma_t": volume}


def density(share_of_empty: float = 0.0) -> np.ndarray:
    numbers = np.random.default_rng(3)
    values = numbers.uniform(0.2, 1.5, _SHAPE)
    return np.where(numbers.random(_SHAPE) < share_of_empty, 0, values)


def load(scene: dict[str, Any]) -> tuple[mi.Scene, mi.SceneParameters]:
    loaded = mi.load_dict(scene, optimize=False)
    return loaded, mi.traverse(loaded)


def keys_of(parameters: mi.SceneParameters, *ends: str) -> list[str]:
    return [key for key in parameters.keys() if key.endswith(ends)]


def weights(image: mi.TensorXf) -> mi.TensorXf:
    numbers = np.random.default_rng(5).uniform(0.5, 1.5, image.shape)
    return mi.TensorXf(numbers.astype(np.float32))


def backward(scene, parameters, keys, integrator, seed: int, spp: int) -> list[np.ndarray]:
    """The gradients of the mean of the image, weighted by random numbers."""
    for key in keys:
        dr.enable_grad(parameters[key])
        dr.set_grad(parameters[key], 0)
    parameters.update()
    image = mi.render(
        scene, parameters, integrator=integrator, seed=seed, seed_grad=seed + 500, spp=spp
    )
    dr.backward(dr.mean(image * weights(image), axis=None))
    found = [np.array(dr.grad(parameters[key])).ravel() for key in keys]
    dr.disable_grad([parameters[key] for key in keys])
    return found


def forward(scene, parameters, key: str, integrator, seed: int, spp: int) -> float:
    """The derivative of the same mean, where all values of a parameter change alike."""
    start, step = dr.detach(parameters[key]), mi.Float(0)
    dr.enable_grad(step)
    parameters[key] = start + step
    parameters.update()
    image = mi.render(
        scene, parameters, integrator=integrator, seed=seed, seed_grad=seed + 500, spp=spp
    )
    dr.forward(step)
    parameters[key] = start
    parameters.update()
    return float(dr.mean(dr.grad(image) * weights(image), axis=None).array[0])


def z_scores(ours: np.ndarray, theirs: np.ndarray | float) -> np.ndarray:
    error = ours.var(axis=0, ddof=1) / len(ours)
    if isinstance(theirs, np.ndarray):
        error = error + theirs.var(axis=0, ddof=1) / len(theirs)
        theirs = theirs.mean(axis=0)
    return (ours.mean(axis=0) - theirs) / np.sqrt(error)


def test_gradients_agree_with_prbvolpath() -> None:
    """Two media meet: coloured fog, and a cloud beside it. (The clouds of ``prbvolpath`` have
    gradients that are 0.9 % off; finite differences agree with ours.)"""
    place = mi.ScalarTransform4f().translate([2.2, 0, 0])
    scene = fog("area", homogeneous([1.0, 0.5, 0.3], [0.8, 0.6, 0.9]))
    scene["cloud"] = {**cube(cloud(density())), "to_world": place}
    scene["cloud"]["interior"]["sigma_t"]["to_world"] = place.translate([-1, -1, -1]).scale(2)
    loaded, parameters = load(scene)
    keys = keys_of(
        parameters, ".albedo.value.value", ".sigma_t.value.value", ".sigma_t.data", ".g",
        "light.emitter.radiance.value", "floor.bsdf.reflectance.value",
    )  # fmt: skip
    assert len(keys) == 7
    ours, theirs = (
        [backward(loaded, parameters, keys, make(name), 20 * first + seed, 96)
         for seed in range(8)]
        for first, name in enumerate(("composed_prb", "prbvolpath"))
    )  # fmt: skip
    for index, key in enumerate(keys):
        found, expected = (np.array([each[index].sum() for each in x]) for x in (ours, theirs))
        assert abs(z_scores(found, expected)) < 6, key
        assert found.std(ddof=1) < (0.4 if "sigma_t.data" in key else 0.2) * abs(found.mean()), key


def in_a_furnace(medium: dict[str, Any]) -> dict[str, Any]:
    """A cube under a constant sky, seen along its axis."""
    view = lookat([0, 0, 9], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene",
        "sensor": sensor(to_world=view, fov=3.0, film=film(4, 4)),
        "sky": {"type": "constant", "radiance": 1.0},
        "cloud": cube(medium),
    }


@pytest.mark.parametrize("share_of_empty", [0.5, 1.0, None])
def test_in_a_white_furnace_extinction_has_no_gradient_where_a_medium_is_empty(
    share_of_empty: float | None,
) -> None:
    """What scatters into a ray replaces what scatters out of it. A path that scatters in proportion
    to the extinction never finds the former: the derivative would be −2, the length of the way."""
    empty = homogeneous(0.0, 1.0)
    medium = empty if share_of_empty is None else cloud(density(share_of_empty), albedo=1.0)
    loaded, parameters = load(in_a_furnace(medium))
    (key,) = keys_of(parameters, ".sigma_t.data", ".sigma_t.value.value")
    integrator = make(max_depth=-1)
    found = np.array(
        [backward(loaded, parameters, [key], integrator, seed, 256)[0] for seed in range(8)]
    )
    is_empty = np.array([share_of_empty is None or density(share_of_empty).ravel() == 0]).ravel()
    for sum_of_some in (found[:, is_empty].sum(axis=1), found.sum(axis=1)):
        assert abs(z_scores(sum_of_some, 0.0)) < 6
        assert sum_of_some.std(ddof=1) < 0.15


def test_black_fog_has_the_gradient_of_the_light_that_it_would_scatter_once() -> None:
    """The integral, along a ray through the cube, of σ T(t) and the mean transmittance of the ways
    from there to the sky."""
    loaded, parameters = load(in_a_furnace(homogeneous(1.0, [0.0, 0.0, 0.5], 0.0)))
    (key,) = keys_of(parameters, ".albedo.value.value")
    dr.enable_grad(parameters[key])
    image = mi.render(loaded, parameters, integrator=make(max_depth=3), seed=1, spp=8192)
    dr.backward(dr.mean(image[..., :1], axis=None))
    d = np.random.default_rng(1).normal(size=(20000, 1, 3))
    d /= np.linalg.norm(d, axis=2, keepdims=True)
    x, weights = np.polynomial.legendre.leggauss(8)
    p = np.stack([0 * x, 0 * x, x], axis=1)
    way = ((1 - np.sign(d) * p) / abs(d)).min(axis=2)
    expected = np.sum(weights * np.exp(-(1 + x)) * np.exp(-way).mean(axis=0))
    assert dr.grad(parameters[key]).x[0] == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("lamp", [None, "area"])
def test_black_fog_has_no_end_or_a_hidden_lamp_inside(lamp: str | None) -> None:
    """Light that is scattered at most once is linear in the albedo."""
    medium, hidden = {**homogeneous(1.0, 0.0), "id": "fog"}, lamp is not None
    scene = in_a_furnace(medium)
    if hidden:
        place = mi.ScalarTransform4f().translate([0, 0, 0.9]).scale(0.5)
        scene["lamp"] = rectangle(place, emitter=area(1.0))
    else:
        del scene["cloud"], scene["sky"]
        scene |= {"fog": medium, "point": {"type": "point", "position": [1, 0, 7]}}
        scene["sensor"]["medium"] = {"type": "ref", "id": "fog"}
    loaded, parameters = load(scene)
    (key,) = keys_of(parameters, ".albedo.value.value")
    settings = {"max_depth": 2, "hide_emitters": hidden}
    (found,) = backward(loaded, parameters, [key], make(**settings), 1, 4096)
    means = []
    for albedo in (0, 1):
        parameters[key] = type(parameters[key])(albedo)
        parameters.update()
        image = mi.render(loaded, integrator=make("composed_path", **settings), seed=2, spp=1024)
        means.append(float(dr.mean(image * weights(image), axis=None).array[0]))
    assert found.sum() == pytest.approx(means[1] - means[0], rel=0.1)


def test_forward_and_backward_mode_agree() -> None:
    loaded, parameters = load(fog("environment", cloud(density(0.5))))
    integrator = make()
    for key in keys_of(parameters, ".sigma_t.data", "light.radiance.value"):
        (found,) = backward(loaded, parameters, [key], integrator, 3, 64)
        along = forward(loaded, parameters, key, integrator, 3, 64)
        np.testing.assert_allclose(along, found.sum(), rtol=2e-3, err_msg=key)


def test_media_without_optimized_parameters_add_nothing_to_the_kernel(monkeypatch) -> None:
    loaded, parameters = load(fog("area", homogeneous()))
    (floor,) = keys_of(parameters, "floor.bsdf.reflectance.value")
    for name in ("stretch", "_attenuation"):
        monkeypatch.setattr(replay, name, None)
    assert backward(loaded, parameters, [floor], make(), 1, 1)[0].any()


def test_an_image_shows_a_grid_that_has_changed() -> None:
    """Recorded kernels of Dr.Jit 1.5.0 showed an earlier one."""
    loaded, parameters = load(fog("environment", cloud(density())))
    (key,) = keys_of(parameters, ".sigma_t.data")
    integrator = make("composed_path")
    for factor in (1, 4, 4, 0.5, 1):
        parameters[key] = mi.TensorXf((factor * density()).astype(np.float32))
        parameters.update()
        found = integrator.render(loaded, seed=1, spp=16)
        fresh = mi.load_dict(fog("environment", cloud(factor * density())), optimize=False)
        with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
            expected = integrator.render(fresh, seed=1, spp=16)
        np.testing.assert_allclose(found, expected, rtol=1e-3)


HARD = {
    "the camera in fog, hidden lights": (
        lambda: fog_around_the_camera("area", homogeneous([0.2, 0.1, 0.1], [0.8, 0.6, 0.9])),
        {"hide_emitters": True},
    ),
    "fog in glass, a lamp inside": (
        lambda: {**fog("environment"), "inside": LIGHTS["area_inside"],
                 "fog": {**cube(homogeneous(1.0, 0.7)),
                         "bsdf": {"type": "roughdielectric", "alpha": 0.3}}},
        {},
    ),
    "guided distances": (
        lambda: fog_around_the_camera("area", homogeneous([0.2, 0.1, 0.1], [0.8, 0.6, 0.9])),
        {"directions": {"type": "guided_directions", "always_guide": True}, "pilot_spp": 64},
    ),
    "black fog beside empty fog": (
        lambda: {**fog("area", homogeneous([1.0, 0.5, 0.3], [0.0, 0.6, 0.9])),
                 "empty": {**cube(homogeneous(0.0, 0.7)),
                           "to_world": mi.ScalarTransform4f().translate([2.2, 0, 0])}},
        {},
    ),
    "a cloud with holes, learned lights": (
        lambda: {**fog("area", cloud(density(0.4))), "second": LIGHTS["point"]},
        {"next_event": "contribution", "connections": 2},
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", HARD)
def test_gradients_agree_with_finite_differences(case: str) -> None:
    scene, more = HARD[case]
    loaded, parameters = load(scene())
    h, seeds = 0.03, range(8)
    path = make("composed_path", **({"hide_emitters": True} if "hide_emitters" in more else {}))

    def loss(key: str, value: Any, seed: int) -> float:
        parameters[key] = value
        parameters.update()
        image = mi.render(loaded, integrator=path, seed=900 + seed, spp=1024)
        return float(dr.mean(image * weights(image), axis=None).array[0])

    for key in keys_of(parameters, ".albedo.value.value", ".sigma_t.value.value", ".sigma_t.data"):
        start = type(parameters[key])(parameters[key])
        # Three values on one side of the start: an extinction of 0 cannot become smaller
        values = np.array(
            [[loss(key, start + k * h, seed) for k in range(3)] for seed in seeds]
        )
        differences = values @ [-3, 4, -1] / (2 * h)
        parameters[key] = start
        parameters.update()
        found = np.array(
            [backward(loaded, parameters, [key], make(**more), seed, 512)[0].sum()
             for seed in seeds]
        )  # fmt: skip
        if not differences.any():  # the albedo of a medium that is empty
            assert not found.any()
            continue
        assert abs(z_scores(found, differences)) < 6, (key, found.mean(), differences.mean())
        assert found.std(ddof=1) < 0.3 * abs(found.mean()) + 0.002, key
