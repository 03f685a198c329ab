"""Gradients of a small loss, and what they should be."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from tests.support.stage import area, bitmap, rectangle, rgb, stage

#: Which image gradients the loss has.
_SHAPE = (12, 16, 3)


def make(name: str = "composed_prb", **parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": name, "max_depth": 4, **parameters})


def room() -> mi.Scene:
    """Materials, a texture, a rough metal, a lamp and an environment map, all of which have
    gradients."""
    pixels = np.random.default_rng(1).uniform(0.2, 0.8, (2, 3, 3))
    sky = np.random.default_rng(2).uniform(0.5, 1.5, (4, 8, 3))
    texture = {"type": "bitmap", "bitmap": bitmap(pixels), "raw": True}
    T = mi.ScalarTransform4f
    return mi.load_dict(
        stage(
            floor=rectangle(T().scale(2), bsdf={"type": "diffuse", "reflectance": texture}),
            metal={
                "type": "sphere", "center": [-0.5, 0.2, 0.5], "radius": 0.4,
                "bsdf": {"type": "roughconductor", "alpha": 0.3,
                         "specular_reflectance": rgb(0.6, 0.7, 0.8)},
            },
            lamp=rectangle(T().translate([0, 0, 2.5]).rotate([1, 0, 0], 180).scale(0.3),
                           emitter=area(8.0)),
            sky={"type": "envmap", "bitmap": mi.Bitmap(sky.astype(np.float32))},
        ),
        optimize=False,
    )  # fmt: skip


#: A parameter of each kind: the end of its name.
KINDS = (
    "floor.bsdf.reflectance.data", "metal.bsdf.alpha.value",
    "metal.bsdf.specular_reflectance.value", "lamp.emitter.radiance.value", "sky.data",
)  # fmt: skip


def small(scene: mi.Scene) -> mi.SceneParameters:
    parameters = mi.traverse(scene)
    for key in parameters.keys():
        if key.endswith("film.size"):
            parameters[key] = [_SHAPE[1], _SHAPE[0]]
    parameters.update()
    return parameters


def loss_weights() -> mi.TensorXf:
    weights = np.random.default_rng(5).uniform(0.5, 1.5, _SHAPE)
    return mi.TensorXf(weights.astype(np.float32))


def backward(scene, parameters, keys, integrator, seed: int, spp: int) -> list[np.ndarray]:
    # Copies: the environment map keeps one with another column
    values = [type(parameters[key])(dr.detach(parameters[key])) for key in keys]
    for key, value in zip(keys, values):
        dr.enable_grad(value)
        parameters[key] = value
    parameters.update()
    image = mi.render(
        scene, parameters, integrator=integrator, seed=seed, seed_grad=seed + 500, spp=spp
    )
    dr.backward(dr.mean(image * loss_weights(), axis=None))
    for key in keys:
        parameters[key] = dr.detach(parameters[key])
    parameters.update()
    return [np.array(dr.grad(value)).ravel() for value in values]


def keys_of(parameters: mi.SceneParameters) -> list[str]:
    found = [key for kind in KINDS for key in parameters.keys() if key.endswith(kind)]
    assert len(found) == len(KINDS), list(parameters.keys())
    return found


def difference(
    scene: mi.Scene, parameters: mi.SceneParameters, key: str, integrator: mi.Integrator
) -> float:
    """The derivative of the same loss by finite differences."""
    start, h, losses = type(parameters[key])(parameters[key]), 0.05, []
    for step in (h, -h):
        parameters[key] = start + step
        parameters.update()
        image = mi.render(scene, integrator=integrator, seed=4, spp=512)
        losses.append(float(dr.mean(image * loss_weights(), axis=None).array[0]))
    parameters[key] = start
    parameters.update()
    return (losses[0] - losses[1]) / (2 * h)
