"""Cryptomatte: names as numbers, layers of ranked pairs of a name and its coverage, and metadata.

Source: J. Friedman, A. Jones, *Fully Automatic ID Mattes with Support for Motion Blur and
Transparency*, SIGGRAPH posters, 2015; *Cryptomatte Specification*, version 1.2.0.
"""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

#: The number of names of a pixel that an image keeps: those with the largest coverage.
RANKS = 6

_COMPONENTS = "rgba"
_MASK = 0xFFFFFFFF


def channel_names(layer: str) -> list[str]:
    """The channels of a Cryptomatte: ``layer00.r`` has the name of the largest coverage,
    ``layer00.g`` that coverage, ``layer00.b`` and ``layer00.a`` the second, and so on."""
    return [f"{layer}{rank // 2:02d}.{c}" for rank in range(0, RANKS, 2) for c in _COMPONENTS]


def name_as_float(name: str) -> np.float32:
    """The number that stands for a name in the channels."""
    return np.array(_float_bits(name), dtype=np.uint32).view(np.float32)[()]


def metadata(layer: str, names: Sequence[str]) -> dict[str, str]:
    """The attributes of an EXR that describe a Cryptomatte."""
    key = f"cryptomatte/{murmur3(layer.encode()):08x}"[: len("cryptomatte/") + 7]
    manifest = {name: f"{_float_bits(name):08x}" for name in names}
    return {
        f"{key}/name": layer,
        f"{key}/hash": "MurmurHash3_32",
        f"{key}/conversion": "uint32_to_float32",
        f"{key}/manifest": json.dumps(manifest, ensure_ascii=False, separators=(",", ":")),
    }


def murmur3(data: bytes, seed: int = 0) -> int:
    """MurmurHash3_x86_32, by A. Appleby (public domain)."""
    h, whole = seed, len(data) // 4 * 4
    for start in range(0, whole, 4):
        h = _rotated(h ^ _mixed(int.from_bytes(data[start : start + 4], "little")), 13)
        h = (h * 5 + 0xE6546B64) & _MASK
    h ^= _mixed(int.from_bytes(data[whole:], "little"))
    h ^= len(data)
    h = ((h ^ h >> 16) * 0x85EBCA6B) & _MASK
    h = ((h ^ h >> 13) * 0xC2B2AE35) & _MASK
    return h ^ h >> 16


def _mixed(word: int) -> int:
    return _rotated(word * 0xCC9E2D51 & _MASK, 15) * 0x1B873593 & _MASK


def _rotated(word: int, count: int) -> int:
    return (word << count | word >> 32 - count) & _MASK


def _float_bits(name: str) -> int:
    """The hash of a name, changed so that its bits are a finite number with full precision."""
    bits = murmur3(name.encode())
    return bits ^ 1 << 23 if bits >> 23 & 0xFF in (0, 0xFF) else bits
