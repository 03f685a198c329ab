"""Refractive indices of glasses and other clear materials as functions of the wavelength.

As in catalogues, indices are relative to air at about 20 °C; they hold for the visible range.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

#: The range of Mitsuba's colour matching functions, in nm. Wavelengths outside of it have the index
#: of the nearer end.
VISIBLE = (360.0, 830.0)


@dataclass(frozen=True)
class Constant:
    """An index that does not depend on the wavelength."""

    n: float

    def __call__(self, wavelength: Any) -> Any:
        return self.n


@dataclass(frozen=True)
class Cauchy:
    """n = A + B/λ² + C/λ⁴, λ in µm (A. L. Cauchy, 1836).

    Parameters:
        coefficients: A, B (µm²) and optionally C (µm⁴).
    """

    coefficients: tuple[float, ...]

    def __call__(self, wavelength: Any) -> Any:
        """The index at ``wavelength`` in nm: a number, or values of Dr.Jit."""
        a, b, c = (*self.coefficients, 0.0)[:3]
        squared = _squared_micrometres(wavelength)
        return a + (b + c / squared) / squared


@dataclass(frozen=True)
class Sellmeier:
    """n² = 1 + Σ Bλ² / (λ² − C), λ in µm (W. Sellmeier, 1872).

    Parameters:
        terms: Pairs of B and C (µm²).
    """

    terms: tuple[tuple[float, float], ...]

    def __call__(self, wavelength: Any) -> Any:
        """The index at ``wavelength`` in nm: a number, or values of Dr.Jit."""
        squared = _squared_micrometres(wavelength)
        return dr.sqrt(1 + sum(b * squared / (squared - c) for b, c in self.terms))


Index = Callable[[Any], Any]


def _sellmeier(b: tuple[float, ...], c: tuple[float, ...]) -> Sellmeier:
    return Sellmeier(tuple(zip(b, c)))


def _resonances(*terms: tuple[float, float]) -> Sellmeier:
    """Sellmeier's formula from pairs of B and the wavelength √C in µm."""
    return Sellmeier(tuple((b, wavelength**2) for b, wavelength in terms))


#: Materials by their names in scene files. From Schott's data sheets (2017), except the last four:
#: fused silica (I. H. Malitson, 1965), water of 20 °C (M. Daimon, A. Masumura, 2007), diamond
#: (F. Peter, 1923), and the ordinary ray of sapphire (I. H. Malitson, M. J. Dodge, 1972).
GLASSES: dict[str, Sellmeier] = {
    "bk7": _sellmeier(
        (1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653)
    ),
    "bak4": _sellmeier(
        (1.28834642, 0.132817724, 0.945395373), (0.00779980626, 0.0315631177, 105.965875)
    ),
    "f2": _sellmeier(
        (1.34533359, 0.209073176, 0.937357162), (0.00997743871, 0.0470450767, 111.886764)
    ),
    "sf6": _sellmeier(
        (1.72448482, 0.390104889, 1.04572858), (0.0134871947, 0.0569318095, 118.557185)
    ),
    "sf10": _sellmeier(
        (1.61625977, 0.259229334, 1.07762317), (0.0127534559, 0.0581983954, 116.60768)
    ),
    "sf11": _sellmeier(
        (1.73848403, 0.311168974, 1.17490871), (0.0136068604, 0.0615960463, 121.922711)
    ),
    "n-sf6": _sellmeier(
        (1.77931763, 0.338149866, 2.08734474), (0.0133714182, 0.0617533621, 174.01759)
    ),
    "n-sf11": _sellmeier(
        (1.73759695, 0.313747346, 1.89878101), (0.013188707, 0.0623068142, 155.23629)
    ),
    "fused silica": _resonances(
        (0.6961663, 0.0684043), (0.4079426, 0.1162414), (0.8974794, 9.896161)
    ),
    "water": _sellmeier(
        (0.5684027565, 0.1726177391, 0.02086189578, 0.1130748688),
        (0.005101829712, 0.01821153936, 0.02620722293, 10.69792721),
    ),
    "diamond": _resonances((0.3306, 0.175), (4.3356, 0.106)),
    "sapphire": _resonances(
        (1.4313493, 0.0726631), (0.65054713, 0.1193242), (5.3414021, 18.028251)
    ),
}


def check_index(index: Index) -> None:
    """Checks that ``index`` is a positive number at each visible wavelength.

    Raises:
        ValueError: It is not positive at some visible wavelength, or Sellmeier's formula has a pole
            there.
    """
    for _b, c in getattr(index, "terms", ()):
        pole = 1000 * math.sqrt(max(c, 0.0))
        if VISIBLE[0] <= pole <= VISIBLE[1]:
            raise ValueError(f"it has a pole at {pole:.6g} nm")
    for wavelength in range(int(VISIBLE[0]), int(VISIBLE[1]) + 1):
        # A root of a negative number is NaN, which is not positive either
        if not 0 < float(index(float(wavelength))) < math.inf:
            raise ValueError(f"it is not a positive number at {wavelength} nm")


def _squared_micrometres(wavelength: Any) -> Any:
    return (1e-3 * dr.clip(wavelength, *VISIBLE)) ** 2
