"""Random scenes of everything that Mitsuba's ``path`` renders: a seed makes a scene.

Combinations that ``path`` itself renders wrongly are left out; each is named where it would be.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from tests.support.lights import ball

Scene = dict[str, Any]

#: Samples per pixel: a square, and a power of two; the square of a prime for "orthogonal".
SPP, PRIME_SPP = 64, 49


class Maker:
    """Makes scenes, and parts of them, for ``mi.load_dict(…, optimize=False)``: where Mitsuba
    merges rectangles, sky and sun leak in ``path``.

    Parameters:
        seed: Selects the scene.
        folder: The folder for files of curves.
        stream: Selects another sequence of random numbers for the same seed.
    """

    def __init__(self, seed: int, folder: Path, stream: int = 7) -> None:
        self.rng, self.folder = np.random.default_rng([seed, stream]), folder
        #: How far things are from the middle, and how large they are.
        self.spread, self.size = 1.2, (0.2, 0.7)

    def scene(self) -> Scene:
        scene: Scene = {"type": "scene", "sensor": self.sensor(), "floor": self.floor()}
        for index in range(self.rng.integers(1, 5)):
            scene.update(self.thing(f"thing_{index}"))
        for index in range(self.rng.integers(1, 4)):
            scene[f"light_{index}"] = self.pick(self.LIGHTS)
        if self.chance(0.5):
            scene["environment"] = self.pick(self.ENVIRONMENTS)
        return scene

    # ---- Choices ----

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def number(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def choice(self, *values: Any) -> Any:
        return values[self.rng.integers(len(values))]

    def pick(self, makers: list[Callable[[Maker], Scene]]) -> Scene:
        return makers[self.rng.integers(len(makers))](self)

    def large(self) -> Maker:
        """From now on, objects are large and in the middle, so that the camera sees them."""
        self.spread, self.size = 0.5, (0.5, 0.9)
        return self

    def point(self) -> list[float]:
        spread = self.spread
        x, y, z = self.rng.uniform([-spread, -spread, 0.1], [spread, spread, 1.8])
        return [float(x), float(y), float(z)]

    def place(self, uniform: bool = False, size: tuple[float, float] | None = None) -> Any:
        axis = self.rng.normal(size=3)
        scale = self.rng.uniform(*(size or self.size), 3)
        T = mi.ScalarTransform4f().translate(self.point())
        # A longer axis would scale the scene
        T = T.rotate((axis / np.linalg.norm(axis)).tolist(), self.number(0, 360))
        return T.scale([float(scale[0])] * 3 if uniform else scale.tolist())

    # ---- Colours ----

    def colour(self, low: float = 0.1, high: float = 0.9) -> Scene:
        return {"type": "rgb", "value": self.rng.uniform(low, high, 3).tolist()}

    def texture(self, low: float = 0.1, high: float = 0.9) -> Scene:
        if self.chance(0.3):
            to_uv = mi.ScalarTransform4f().scale([self.number(1, 4), self.number(1, 4), 1])
            # It accepts reflectances only
            low, high = min(low, 0.5), min(high, 1)
            return {"type": "checkerboard", "color0": self.colour(low, high),
                    "color1": self.colour(low, high), "to_uv": to_uv}  # fmt: skip
        return self.bitmap(low, high)

    def bitmap(self, low: float, high: float) -> Scene:
        pixels = self.rng.uniform(low, high, (*self.rng.integers(2, 9, 2), 3))
        if self.chance(0.3):  # bright in few places
            pixels *= self.rng.random(pixels.shape[:2])[..., None] < 0.2
            pixels.flat[:3] = high
        return {"type": "bitmap", "bitmap": mi.Bitmap(pixels.astype(np.float32)),
                "filter_type": self.choice("bilinear", "nearest")}  # fmt: skip

    def weights(self) -> Scene:
        """A texture of numbers: in spectral variants, ``path`` refuses colours in their place."""
        texture = self.texture()
        if texture["type"] == "bitmap":
            return {**texture, "raw": True}
        colours = {key: float(np.mean(texture[key]["value"])) for key in ("color0", "color1")}
        return {**texture, **colours}

    def reflectance(self) -> Scene:
        return self.texture() if self.chance(0.4) else self.colour()

    # ---- Materials ----

    def opaque(self) -> Scene:
        alpha = self.number(0.1, 0.5)
        distribution = self.choice("ggx", "beckmann")
        return self.choice(
            lambda: {"type": "diffuse", "reflectance": self.reflectance()},
            lambda: {"type": "conductor", "material": "Au"},
            lambda: {"type": "roughconductor", "alpha": alpha, "distribution": distribution},
            lambda: {"type": "plastic", "diffuse_reflectance": self.reflectance(),
                     "nonlinear": self.chance(0.5)},
            lambda: {"type": "roughplastic", "alpha": alpha,
                     "diffuse_reflectance": self.reflectance()},
            lambda: {"type": "principled", "base_color": self.reflectance(),
                     "roughness": self.number(0.3, 1), "metallic": self.number(0, 1),
                     "clearcoat": self.number(0, 1), "sheen": self.number(0, 1)},
        )()  # fmt: skip

    def glass(self) -> Scene:
        return {"type": "principled", "base_color": self.colour(), "spec_trans": 0.7,
                "roughness": self.number(0.4, 1)}  # fmt: skip

    def film_of_glass(self) -> Scene:
        return {"type": "principledthin", "base_color": self.colour(), "spec_trans": 0.3,
                "diff_trans": self.number(0, 2), "roughness": self.number(0.4, 1)}  # fmt: skip

    def bsdf(self) -> Scene:
        alpha = self.number(0.15, 0.5)
        return self.choice(
            self.opaque,
            lambda: {"type": "twosided", "bsdf": self.opaque()},
            lambda: {"type": "twosided", "front": self.opaque(), "back": self.opaque()},
            lambda: {"type": "dielectric", "int_ior": self.number(1.1, 1.8)},
            lambda: {"type": "thindielectric"},
            lambda: {"type": "roughdielectric", "alpha": alpha,
                     "distribution": self.choice("ggx", "beckmann")},
            self.glass,
            self.film_of_glass,
            lambda: {"type": "mask", "opacity": self.choice(self.number(0.2, 0.8), self.weights()),
                     "bsdf": self.opaque()},
            # Not with mirrors: Mitsuba adds probabilities and densities there
            lambda: {"type": "blendbsdf", "weight": self.choice(0.4, self.weights()),
                     "first": {"type": "roughplastic", "alpha": alpha},
                     "second": {"type": "diffuse", "reflectance": self.reflectance()}},
            lambda: {"type": "bumpmap", "texture": {**self.bitmap(0, 1), "raw": True},
                     "scale": 0.1, "bsdf": self.opaque()},
            lambda: {"type": "normalmap", "bsdf": self.opaque(),
                     "normalmap": {**self.bitmap(0.4, 0.9), "raw": True}},
            lambda: {"type": "null"},
        )()  # fmt: skip

    # ---- Shapes ----

    def floor(self) -> Scene:
        to_world = mi.ScalarTransform4f().scale(2.5)
        return {"type": "rectangle", "to_world": to_world, "bsdf": self.opaque()}

    def shape(self) -> Scene:
        return self.choice(
            lambda: {"type": "sphere", "to_world": self.place(uniform=True)},
            lambda: {"type": "cube", "to_world": self.place()},
            lambda: {"type": "rectangle", "to_world": self.place()},
            lambda: {"type": "disk", "to_world": self.place()},
            lambda: {"type": "cylinder", "to_world": self.place(uniform=True)},
            lambda: {**ball(9, 5, smooth=self.chance(0.5)), "to_world": self.place()},
        )()

    def thing(self, name: str) -> Scene:
        """A shape, or a group of shapes and its instance."""
        bsdf = self.bsdf()
        kind = self.rng.random()
        if kind < 0.15:
            group = {"type": "shapegroup", "shape": {**self.shape(), "bsdf": bsdf}}
            to_world = mi.ScalarTransform4f().translate([self.number(-0.5, 0.5), 0.0, 0.1])
            instance = {"type": "instance", "to_world": to_world,
                        "group": {"type": "ref", "id": f"{name}_group"}}  # fmt: skip
            return {f"{name}_group": group, name: instance}
        if kind < 0.3:
            return {name: self.curve()}
        return {name: {**self.shape(), "bsdf": bsdf}}

    def curve(self) -> Scene:
        path = self.folder / f"{self.rng.integers(1 << 31)}.txt"
        points = self.rng.uniform([-0.9, -0.9, 0.2, 0.05], [0.9, 0.9, 1.2, 0.2], (6, 4))
        path.write_text("\n".join(" ".join(map(str, row)) for row in points))
        return {"type": self.choice("bsplinecurve", "linearcurve"), "filename": str(path),
                "bsdf": {"type": "twosided", "bsdf": self.opaque()}}  # fmt: skip

    # ---- Lights ----

    def area_light(self) -> Scene:
        # Not with interpolated normals: Mitsuba samples such meshes with a wrong density
        shape = self.choice(
            lambda: {"type": "sphere", "to_world": self.place(True, (0.1, 0.4))},
            lambda: {"type": "cylinder", "to_world": self.place(True, (0.1, 0.4))},
            lambda: {"type": "cube", "to_world": self.place(size=(0.1, 0.4))},
            lambda: {**ball(7, 4), "to_world": self.place(size=(0.1, 0.4))},
            lambda: {"type": "rectangle", "to_world": self.place()},
            lambda: {"type": "disk", "to_world": self.place()},
        )()
        emitter = {"type": "area", "radiance": self.colour(1, 8), **self.weight()}
        # Mitsuba looks up textures in a wrong frame on turned spheres and cylinders, and on one
        # face only of a cube
        if shape["type"] in ("rectangle", "disk") and self.chance(0.6):
            emitter["radiance"] = self.texture(1, 8)
        if shape["type"] in ("rectangle", "disk") and self.chance(0.15):
            emitter["type"] = "directionalarea"
            emitter["radiance"] = self.colour(1, 4)
        return {**shape, "emitter": emitter}

    def weight(self) -> Scene:
        return {"sampling_weight": self.number(0.2, 4)} if self.chance(0.2) else {}

    def aim(self) -> Any:
        origin = [self.number(-1.5, 1.5), self.number(-1.5, 1.5), self.number(1.5, 2.5)]
        target = [self.number(-0.5, 0.5), self.number(-0.5, 0.5), 0.0]
        return mi.ScalarTransform4f().look_at(origin, target, [0, 1, 0])

    def spot(self) -> Scene:
        spot = {"type": "spot", "to_world": self.aim(), "intensity": self.colour(2, 20),
                "cutoff_angle": self.number(10, 60), **self.weight()}  # fmt: skip
        return {**spot, "texture": self.texture()} if self.chance(0.5) else spot

    def projector(self) -> Scene:
        return {"type": "projector", "to_world": self.aim(), "irradiance": self.bitmap(0.1, 1),
                "scale": self.number(1, 5), "fov": self.number(20, 60),
                **self.weight()}  # fmt: skip

    def directional(self) -> Scene:
        return {"type": "directional", "direction": [*self.rng.normal(size=2).tolist(), -1.5],
                "irradiance": self.colour(0.5, 3), **self.weight()}  # fmt: skip

    def point_light(self) -> Scene:
        return {"type": "point", "position": self.point(), "intensity": self.colour(),
                **self.weight()}  # fmt: skip

    LIGHTS = [area_light, area_light, area_light, spot, projector, directional, point_light]

    def constant(self) -> Scene:
        return {"type": "constant", "radiance": self.colour(), **self.weight()}

    def envmap(self) -> Scene:
        image = self.rng.uniform(0, 1, (*self.rng.integers(4, 20, 2), 3))
        image[self.rng.integers(image.shape[0]), 0] *= self.number(1, 30)
        return {"type": "envmap", "bitmap": mi.Bitmap(image.astype(np.float32)),
                "to_world": self.turn()}  # fmt: skip

    def sky(self) -> Scene:
        # A brighter sun makes caustics that no number of samples of a test can estimate
        return {"type": "sunsky", "sun_scale": self.choice(0.0, 0.01), "sky_scale": 0.05,
                "sun_direction": [*self.rng.normal(size=2).tolist(), self.number(0.2, 2)]}

    def turn(self) -> Any:
        return mi.ScalarTransform4f().rotate([0, 0, 1], self.number(0, 360))

    ENVIRONMENTS = [constant, envmap, sky]

    # ---- Sensors ----

    def sensor(self) -> Scene:
        T = mi.ScalarTransform4f
        origin = [self.number(-2, 2), self.number(-4, -3), self.number(0.5, 2.5)]
        view = T().look_at(origin, [0, 0, 0.6], [0, 0, 1])
        film = self.film()
        # Not "ldsampler": its numbers depend on each other
        sampler = self.choice("independent", "stratified", "multijitter", "orthogonal")
        spp = PRIME_SPP if sampler == "orthogonal" else SPP
        common = {"film": film, "sampler": {"type": sampler, "sample_count": spp}}
        kind = self.rng.random()
        if kind < 0.2:
            return {"type": "thinlens", "fov": 40, "aperture_radius": self.number(0.02, 0.2),
                    "focus_distance": 3.5, "to_world": view, **common}  # fmt: skip
        if kind < 0.35:
            return {"type": "orthographic", "to_world": view @ T().scale(1.5), **common}
        return {"type": "perspective", "fov": self.number(25, 60), "to_world": view, **common}

    def film(self) -> Scene:
        width, height = (int(n) for n in self.rng.integers(6, 13, 2))
        # Filters with negative lobes make negative pixels
        film = {"type": "hdrfilm", "width": width, "height": height,
                "pixel_format": self.choice("rgb", "rgba", "luminance"),
                "rfilter": {"type": self.choice("box", "tent", "gaussian")}}  # fmt: skip
        if self.chance(0.2):
            film |= {"crop_width": 5, "crop_height": 4, "crop_offset_x": 1, "crop_offset_y": 1}
        return film | {"sample_border": self.chance(0.2)}


class NestedMaker(Maker):
    """BSDFs that hold others, each of them rough, on shapes that are sheared and mirrored as well.

    Mirrored spheres and cylinders are left out: Mitsuba keeps their normals as they were.
    """

    def place(self, uniform: bool = False, size: tuple[float, float] | None = None) -> Any:
        T = super().place(uniform, size)
        if uniform:
            return T
        shear = np.eye(4)
        shear[:3, :3] += self.rng.uniform(-0.6, 0.6, (3, 3)) * (1 - np.eye(3))
        mirror = [float(x) for x in self.rng.choice([-1, 1], 3)]
        return T @ mi.ScalarTransform4f(shear).scale(mirror)

    def rough(self) -> Scene:
        """Rough, and black from behind."""
        alpha, distribution = self.number(0.05, 0.5), self.choice("ggx", "beckmann")
        return self.choice(
            lambda: {"type": "roughconductor", "alpha": alpha, "distribution": distribution,
                     "sample_visible": self.chance(0.8)},
            lambda: {"type": "roughconductor", "alpha_u": alpha, "alpha_v": self.number(0.1, 0.5)},
            lambda: {"type": "roughplastic", "alpha": alpha, "distribution": distribution,
                     "diffuse_reflectance": self.reflectance()},
            lambda: {"type": "principled", "base_color": self.reflectance(), "roughness": alpha,
                     "metallic": self.number(0, 1), "clearcoat": self.number(0, 1)},
            lambda: {"type": "diffuse", "reflectance": self.reflectance()},
        )()  # fmt: skip

    def transparent(self) -> Scene:
        """Rough, and seen from both sides."""
        alpha = self.number(0.15, 0.5)
        return self.choice(
            lambda: {"type": "twosided", "bsdf": self.rough()},
            lambda: {"type": "roughdielectric", "alpha": alpha,
                     "distribution": self.choice("ggx", "beckmann")},
            self.glass,
            self.film_of_glass,
        )()  # fmt: skip

    def opaque(self) -> Scene:
        return self.blend(self.rough)

    def bsdf(self) -> Scene:
        """A rough or a transparent BSDF. It is no blend of both: Mitsuba samples a blend with a
        wrong density from behind."""
        return self.nested(self.choice(self.rough, self.rough, self.transparent))

    def nested(self, inner: Callable[[], Scene]) -> Scene:
        return self.choice(
            lambda: self.blend(inner),
            lambda: self.blend(inner),
            lambda: {"type": "mask", "opacity": self.choice(self.number(0.2, 0.8), self.weights()),
                     "bsdf": self.blend(inner)},
            lambda: {"type": "bumpmap", "texture": {**self.bitmap(0, 1), "raw": True},
                     "scale": self.number(0.05, 0.5), "bsdf": inner()},
            lambda: {"type": "normalmap", "bsdf": inner(),
                     "normalmap": {**self.bitmap(0.2, 0.9), "raw": True}},
            lambda: {"type": "blendbsdf", "weight": self.number(0, 1), "second": inner(),
                     "first": {"type": "bumpmap", "texture": {**self.bitmap(0, 1), "raw": True},
                               "scale": 0.1, "bsdf": inner()}},
        )()  # fmt: skip

    def blend(self, inner: Callable[[], Scene]) -> Scene:
        weight = self.choice(self.number(0, 1), self.weights())
        return {"type": "blendbsdf", "weight": weight, "first": inner(), "second": inner()}
