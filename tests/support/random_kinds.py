"""Kinds of random scenes: the scene to test, and the scene of the same mean that ``path`` renders.

Each load makes all objects of a scene anew: in spectral variants, Mitsuba converts the pixels of an
``mi.Bitmap`` in place (``docs/mitsuba_faults.md``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from mitsuba_ext.transport.materials.glass import GLASSES
from tests.support.lights import ball
from tests.support.motions import Pose, keyed, uniform
from tests.support.random_scenes import Maker, NestedMaker, Scene


@dataclass(frozen=True)
class Kind:
    """A kind of scenes.

    Attributes:
        make: Makes the scene of a number; its files go to a folder. If the time is ``None``: the
            scene to test; else the one that ``path`` renders for this time (0 to 1) of the shutter
            interval.
        strata: Number of parts of the shutter interval; ``path`` renders each at a random time, so
            that the mean of its images is the mean over the interval.
        depth: Parameters of integrators that this kind prescribes.
        allowance: Accepted relative difference of the means.
        reference: Mitsuba's integrator, where it is not ``path``.
    """

    make: Callable[[int, Path, float | None], Scene]
    strata: int = 1
    depth: dict[str, int] = field(default_factory=dict)
    allowance: float = 0.0
    reference: str = "path"


def _plain(seed: int, folder: Path, time: float | None) -> Scene:
    return Maker(seed, folder).scene()


def _nested(seed: int, folder: Path, time: float | None) -> Scene:
    return NestedMaker(seed, folder, stream=31).scene()


# ---- Moving shapes, cameras and lights ----


def _moving(seed: int, folder: Path, time: float | None) -> Scene:
    """One or two shapes move: inside of ``moving``, or placed where they are at the given time."""
    scene, maker = Maker(seed, folder).large().scene(), Maker(seed, folder, stream=13)
    opens, lasts = maker.number(0, 0.3), maker.number(0.2, 1)
    scene["sensor"] |= {"shutter_open": opens, "shutter_close": opens + lasts}
    names = [name for name in scene if name.startswith("thing_") and "group" not in name]
    for name in maker.rng.permutation(names)[: maker.rng.integers(1, 3)]:
        parameters, pose = _motion(maker)
        group = f"{name}_group"
        parts = {key: scene.pop(key) for key in (group, name) if key in scene}
        if group in parts:
            parts[group]["id"] = group
        if time is None:
            scene[name] = {"type": "moving", **parameters, **parts}
        else:
            to_world = parts[name].get("to_world", mi.ScalarTransform4f())
            moved = mi.ScalarTransform4f(pose(opens + time * lasts)) @ to_world
            scene |= parts | {name: {**parts[name], "to_world": moved}}
    return scene


def _moving_camera(seed: int, folder: Path, time: float | None) -> Scene:
    """The camera moves as well."""
    scene, maker = _moving(seed, folder, time), Maker(seed, folder, stream=23)
    still = scene["sensor"]
    opens, lasts = still["shutter_open"], still["shutter_close"] - still["shutter_open"]
    if maker.chance(0.5):
        translate, axis = maker.rng.normal(size=(2, 3))
        parameters, pose = uniform((0.3 * translate).tolist(), axis.tolist(),
                                   maker.number(-20, 20), maker.point())  # fmt: skip
    else:
        turns, positions = maker.rng.normal(size=(2, 3, 3))
        turns = Rotation.from_rotvec(0.1 * turns)
        parameters, pose = keyed(opens + lasts * np.array([0.1, 0.4, 0.9]), turns, 0.2 * positions)
    if time is None:
        scene["sensor"] = {"type": "moving_camera", **parameters, "still": still}
    else:
        place = mi.ScalarTransform4f(pose(opens + time * lasts))
        scene["sensor"] = {**still, "to_world": place @ still["to_world"]}
    return scene


def _moving_lights(seed: int, folder: Path, time: float | None) -> Scene:
    """All lights move but those at infinity."""
    scene, maker = Maker(seed, folder).scene(), Maker(seed, folder, stream=29)
    opens, lasts = maker.number(0, 0.3), maker.number(0.2, 1)
    scene["sensor"] |= {"shutter_open": opens, "shutter_close": opens + lasts}
    for name in [name for name in scene if name.startswith("light_")]:
        light = scene[name]
        if light["type"] == "directional":
            continue
        translate, axis = maker.rng.normal(size=(2, 3))
        parameters, pose = uniform((0.3 * translate).tolist(), axis.tolist(),
                                   maker.number(-90, 90), maker.point())  # fmt: skip
        if time is None:
            plugin = "moving" if "emitter" in light else "moving_light"
            scene[name] = {"type": plugin, **parameters, "light": light}
            continue
        there = mi.ScalarTransform4f(pose(opens + time * lasts))
        if "position" in light:
            light["position"] = (there @ mi.ScalarPoint3f(light["position"])).numpy().tolist()
        else:
            light["to_world"] = there @ light["to_world"]
    return scene


def _motion(maker: Maker) -> tuple[Scene, Pose]:
    rng = maker.rng
    if maker.chance(0.5):
        translate, axis = rng.normal(size=(2, 3))
        begin = maker.number(-0.2, 0.3)
        return uniform((0.4 * translate).tolist(), axis.tolist(), maker.number(-500, 500),
                       maker.point(), begin, begin + maker.number(0.3, 1.2))  # fmt: skip
    count = rng.integers(2, 5)
    times = np.cumsum(rng.uniform(0.1, 0.5, count))
    turns, positions = rng.normal(size=(2, count, 3))
    return keyed(times, Rotation.from_rotvec(turns), 0.3 * positions)


# ---- Dispersive glass ----


def _constant_index(seed: int, folder: Path, time: float | None) -> Scene:
    """Glass in a scene: with an index that does not depend on the wavelength, our plugins must
    equal Mitsuba's."""
    scene, maker = Maker(seed, folder).scene(), Maker(seed, folder, stream=17).large()
    for index in range(maker.rng.integers(1, 3)):
        glass: Scene = {"type": "dielectric", "int_ior": maker.number(1.2, 1.9)}
        if maker.chance(0.5):
            glass |= {"type": "roughdielectric", "distribution": maker.choice("ggx", "beckmann"),
                      "alpha_u": maker.number(0.1, 0.5),
                      "alpha_v": maker.number(0.1, 0.5)}  # fmt: skip
        if maker.chance(0.3):
            glass["ext_ior"] = 1.1
        if maker.chance(0.3):
            glass["specular_transmittance"] = maker.reflectance()
        if time is None:
            glass["type"] = f"dispersive_{glass['type']}"
        if maker.chance(0.3):
            glass = {"type": "mask", "opacity": maker.number(0.4, 0.8), "bsdf": glass}
        scene[f"glass_{index}"] = {**maker.shape(), "bsdf": glass}
    return scene


def _furnace(seed: int, folder: Path, time: float | None) -> Scene:
    """Dispersive glass under a constant sky: glass absorbs nothing, so it is invisible. ``path``
    renders the sky alone."""
    maker = Maker(seed, folder, stream=19).large()
    sky = {"type": "constant", "radiance": maker.colour()}
    scene = {"type": "scene", "sensor": maker.sensor(), "sky": sky}
    # Behind glass, opacity is 1
    scene["sensor"]["film"]["pixel_format"] = "rgb"
    for index in range(maker.rng.integers(1, 4) if time is None else 0):
        glass = {"type": "dispersive_dielectric", **_index(maker)}
        if maker.chance(0.3):
            # Smooth, so that little energy is lost to multiple scattering in the microsurface
            glass |= {"type": "dispersive_roughdielectric", "distribution": "ggx", "alpha": 0.002}
        scene[f"glass_{index}"] = {**_closed(maker), "bsdf": glass}
    return scene


def _index(maker: Maker) -> Scene:
    number = maker.number(1.3, 2)
    if not mi.is_spectral:
        return {"int_ior": number}
    cauchy = f"{number}, {maker.number(0.002, 0.02)}"
    return maker.choice({"int_ior": maker.choice(*GLASSES)}, {"cauchy": cauchy})


def _closed(maker: Maker) -> Any:
    """A shape with an inside. Interpolated normals would not conserve energy."""
    return maker.choice(
        lambda: {"type": "sphere", "to_world": maker.place(uniform=True)},
        lambda: {"type": "cube", "to_world": maker.place()},
        lambda: {**ball(9, 5), "to_world": maker.place()},
    )()


# ---- Participating media ----


def _media(seed: int, folder: Path, time: float | None) -> Scene:
    """One or two clouds, of which one may hold the camera and all else."""
    scene, maker = Maker(seed, folder).scene(), Maker(seed, folder, stream=17)
    for index in range(maker.rng.integers(1, 3)):
        boundary = {"type": maker.choice("sphere", "cube"), "to_world": maker.place(uniform=True)}
        bsdf = {"type": maker.choice("null", "null", "dielectric", "thindielectric")}
        scene[f"cloud_{index}"] = {**boundary, "bsdf": bsdf, "interior": _medium(maker)}
    if maker.chance(0.3):
        around = {**_medium(maker, is_grid=False), "id": "around", "scale": 0.05}
        # References look back: the medium comes first
        scene = {"type": scene.pop("type"), "around": around, **scene}
        reference = {"type": "ref", "id": "around"}
        scene["sensor"] |= {"medium": reference}
        scene["air"] = {"type": "sphere", "radius": 100.0, "bsdf": {"type": "null"},
                        "interior": reference}  # fmt: skip
    return scene


def _medium(maker: Maker, is_grid: bool | None = None) -> Scene:
    phase = maker.choice(
        {"type": "isotropic"}, {"type": "hg", "g": maker.number(-0.6, 0.8)}, {"type": "rayleigh"}
    )
    if maker.chance(0.4) if is_grid is None else is_grid:
        density = maker.rng.random((4, 3, 5, 1), dtype=np.float32) * maker.number(0.5, 8)
        place = mi.ScalarTransform4f().translate([-3, -3, -1]).scale(6)
        volume = {"type": "gridvolume", "grid": mi.VolumeGrid(density), "to_world": place}
        return {"type": "heterogeneous", "phase": phase, "albedo": maker.colour(),
                "sigma_t": volume}  # fmt: skip
    # Colours that differ much make too much noise
    return {"type": "homogeneous", "phase": phase, "albedo": maker.colour(),
            "sigma_t": maker.colour(0.4, 0.9), "scale": maker.number(0.5, 8),
            "sample_emitters": maker.chance(0.9)}  # fmt: skip


KINDS = {
    "plain": Kind(_plain),
    "nested": Kind(_nested),
    "media": Kind(_media, reference="volpath"),
    "moving": Kind(_moving, strata=16),
    "moving_camera": Kind(_moving_camera, strata=16),
    "moving_lights": Kind(_moving_lights, strata=16),
    "constant_index": Kind(_constant_index),
    # Long paths without roulette: a small max_depth would lose energy, and in RGB roulette would be
    # the only source of noise
    "furnace": Kind(_furnace, depth={"max_depth": -1, "rr_depth": 64}, allowance=2e-3),
}
