"""The common part of dispersive dielectrics: parameters, refractive indices, and the refusal of
callers that do not support dispersion."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from ..heroes import DISPERSES, knows_heroes
from .glass import GLASSES, VISIBLE, Cauchy, Constant, Index, Sellmeier, check_index

#: Names of the media that can be outside, as in Mitsuba. Their index is the same at all
#: wavelengths.
_OUTSIDE = {
    "vacuum": 1.0,
    "helium": 1.000036,
    "hydrogen": 1.000132,
    "air": 1.000277,
    "carbon dioxide": 1.00045,
}

_INSIDE = ("int_ior", "cauchy", "sellmeier")


class DispersiveInterface:
    """A surface between a clear medium, which may be dispersive, and an outer one, which is not.

    Parameters:
        plugin: The plugin's name, for errors.
        props: The plugin's parameters: ``int_ior``, ``cauchy`` or ``sellmeier``, ``ext_ior``,
            ``specular_reflectance``, ``specular_transmittance``.

    Attributes:
        flags: Flags that the plugin adds to the flags of its components.

    Raises:
        RuntimeError: The medium inside is dispersive, and the variant is not spectral.
        TypeError, ValueError: A parameter has a wrong type or value.
    """

    def __init__(self, plugin: str, props: mi.Properties) -> None:
        self._plugin = plugin
        self._description, self._inside = self._read_inside(props)
        self._outside = self._read_outside(props)
        self._textures = {
            name: check_uniform(plugin, name, props.get_texture(name, 1.0), maximum=1.0)
            for name in ("specular_reflectance", "specular_transmittance")
            if name in props
        }
        self._disperses = not isinstance(self._inside, Constant)
        self._has_warned = False
        self.flags = DISPERSES if self._disperses else 0
        if self._disperses and not mi.is_spectral:
            raise RuntimeError(
                f'"{plugin}" cannot disperse light in the variant "{mi.variant()}", which has no '
                f'wavelengths: use a spectral one such as "llvm_ad_spectral", or a number as '
                f'"int_ior".'
            )

    def is_answerable(self, ctx: mi.BSDFContext) -> bool:
        """True if the caller refracts only the hero wavelength, or if there is no dispersion.
        Otherwise the plugin must return :meth:`infinite_sample` or infinite values.

        In a traced call, there is a warning instead of an error: Dr.Jit traces the BSDFs of all
        scenes in memory, and the BSDF cannot know if it is in the scene that is rendered. The
        infinite values reach the image only if it is.

        Raises:
            NotImplementedError: The caller would refract all wavelengths in the hero's direction,
                and calls this BSDF itself.
        """
        if not self._disperses or knows_heroes(ctx):
            return True
        message = (
            f'"{self._plugin}": dispersion needs an integrator of mitsuba_ext, such as '
            f'"composed_path". Mitsuba\'s own would refract all four wavelengths of a ray in the '
            f"direction of the first."
        )
        if not dr.flag(dr.JitFlag.SymbolicScope):
            raise NotImplementedError(message)
        if not self._has_warned:
            self._has_warned = True
            consequence = "Pixels are infinite where its paths meet this BSDF."
            mi.Log(mi.LogLevel.Warn, f"{message} {consequence}")
        return False

    @staticmethod
    def infinite_sample(
        si: mi.SurfaceInteraction3f, sample1: mi.Float
    ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
        """A BSDF sample of infinite weight, in the mirror direction or straight on, so that it
        reaches the surfaces that would be reflected or refracted. (The weight is not NaN, since
        integrators treat a weight of NaN like 0.)"""
        bs = dr.zeros(mi.BSDFSample3f)
        bs.wo = dr.select(mi.Float(sample1) < 0.5, mi.reflect(si.wi), -si.wi)
        bs.pdf, bs.eta = mi.Float(1), mi.Float(1)
        bs.sampled_type = mi.UInt32(+mi.BSDFFlags.Delta)
        return bs, mi.Spectrum(dr.inf)

    def check_differs(self) -> None:
        """Checks that the indices inside and outside differ at all visible wavelengths.

        Raises:
            ValueError: At some wavelength they are the same, where the half vector of a refraction
                is not defined.
        """
        start, end = map(int, VISIBLE)
        n = [self._inside(float(wavelength)) for wavelength in range(start, end + 1)]
        if not (min(n) > self._outside or max(n) < self._outside):
            raise ValueError(
                f'"{self._plugin}": the index inside ({self._description}) and "ext_ior" '
                f"({self._outside:.6g}) must differ at all wavelengths"
            )

    def η(self, si: mi.SurfaceInteraction3f) -> list[mi.Float]:
        """The relative index of refraction, inside / outside: for the hero, then for the other
        wavelengths; a single value if there is no dispersion."""
        if not self._disperses:
            return [mi.Float(self._inside.n / self._outside)]
        η = self._inside(si.wavelengths) / self._outside
        return [η[k] for k in range(dr.size_v(mi.Spectrum))]

    def reflectance(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Spectrum:
        """The parameter ``specular_reflectance``."""
        return self._texture("specular_reflectance", si, active)

    def transmittance(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Spectrum:
        """The parameter ``specular_transmittance``."""
        return self._texture("specular_transmittance", si, active)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        for name, texture in self._textures.items():
            callback.put(name, texture, +mi.ParamFlags.Differentiable)

    def describe(self, *others: str) -> str:
        """The text for ``to_string`` of the plugin; ``others`` are further lines."""
        lines = [f"inside = {self._description}", f"ext_ior = {self._outside:.6g}"]
        lines += [f"{name} = {texture}" for name, texture in self._textures.items()]
        lines = [line.replace("\n", "\n  ") for line in (*lines, *others)]
        return f"{self._plugin}[\n  " + ",\n  ".join(lines) + "\n]"

    # ---- Reading ----

    def _read_inside(self, props: mi.Properties) -> tuple[str, Index]:
        given = [key for key in _INSIDE if key in props]
        if len(given) > 1:
            raise ValueError(
                f'"{self._plugin}": {" and ".join(given)} are given; it must be one of '
                f"{', '.join(_INSIDE)}"
            )
        key = given[0] if given else "int_ior"
        value = props.get(key, "bk7")
        if key == "cauchy":
            index: Index = Cauchy(self._numbers(key, value, (2, 3)))
        elif key == "sellmeier":
            numbers = self._numbers(key, value, (6,))
            index = Sellmeier(tuple(zip(numbers[:3], numbers[3:])))
        elif isinstance(value, str):
            if value.lower() not in GLASSES:
                raise self._error(key, value, f"a number or one of {', '.join(GLASSES)}")
            index = GLASSES[value.lower()]
        else:
            index = Constant(self._positive(key, value))
        try:
            check_index(index)
        except ValueError as error:
            raise ValueError(f'"{self._plugin}": {key} = {value!r}: {error}') from None
        return f"{key} {value}", index

    def _read_outside(self, props: mi.Properties) -> float:
        value = props.get("ext_ior", "air")
        if isinstance(value, str):
            if value.lower() not in _OUTSIDE:
                raise self._error("ext_ior", value, f"a number or one of {', '.join(_OUTSIDE)}")
            return _OUTSIDE[value.lower()]
        return self._positive("ext_ior", value)

    def _positive(self, key: str, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise TypeError(str(self._error(key, value, "a number or a name")))
        if not 0 < value < math.inf:
            raise self._error(key, value, "positive and finite")
        return float(value)

    def _numbers(self, key: str, value: Any, counts: tuple[int, ...]) -> tuple[float, ...]:
        accepted = f"a text of {' or '.join(map(str, counts))} numbers"
        if not isinstance(value, str):
            raise TypeError(str(self._error(key, value, accepted)))
        try:
            numbers = tuple(map(float, value.replace(",", " ").split()))
        except ValueError:
            raise self._error(key, value, accepted) from None
        if len(numbers) not in counts:
            raise self._error(key, value, accepted)
        return numbers

    def _error(self, key: str, value: Any, accepted: str) -> ValueError:
        return ValueError(
            f'"{self._plugin}": the parameter "{key}" is {value!r}; it must be {accepted}'
        )

    def _texture(self, name: str, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Spectrum:
        texture = self._textures.get(name)
        return mi.Spectrum(1) if texture is None else texture.eval(si, active)


def check_uniform(
    plugin: str, key: str, texture: mi.Texture, maximum: float = math.inf
) -> mi.Texture:
    """Returns the texture of the parameter ``key``, after a check of constant textures.

    Raises:
        ValueError: The texture is a constant that is negative, above ``maximum``, or not finite.
    """
    if texture.class_name() == "UniformSpectrum":
        value = float(dr.slice(mi.traverse(texture)["value"]))
        if not (0 <= value <= maximum and value < math.inf):
            accepted = "not negative" if maximum == math.inf else f"0 to {maximum:g}"
            raise ValueError(
                f'"{plugin}": the parameter "{key}" is {value:g}; it must be {accepted}'
            )
    return texture


def fresnel_spectrum(cos_θ: mi.Float, η: list[mi.Float]) -> mi.Spectrum:
    """The Fresnel reflectance at each wavelength."""
    F = [mi.fresnel(cos_θ, η_k)[0] for η_k in η]
    return mi.Spectrum(F if len(F) > 1 else F[0])
