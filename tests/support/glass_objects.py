"""Glass, wrapped in Mitsuba's adapters, for the tests of dispersion."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

WRAPPERS: dict[str, dict[str, Any]] = {
    "mask": {"opacity": 0.6},
    "twosided": {"allow_transmission": True},
    "blendbsdf": {"weight": 0.6, "first": {"type": "diffuse"}},
    "bumpmap": {"texture": "_waves"},
    "normalmap": {"normalmap": "_waves"},
}


def wrapped(wrapper: str | None, bsdf: dict[str, Any]) -> dict[str, Any]:
    """``bsdf``, in one of ``WRAPPERS`` if that is not ``None``."""
    if wrapper is None:
        return bsdf
    parameters = {k: _waves() if v == "_waves" else v for k, v in WRAPPERS[wrapper].items()}
    return {"type": wrapper, **parameters, "nested": bsdf}


def _waves() -> dict[str, Any]:
    """A texture for bumps and, of them, normals."""
    x = np.linspace(0, 4 * np.pi, 64, endpoint=False)
    waves = np.stack(np.broadcast_arrays(np.sin(x), np.cos(x)[:, None], 8), axis=2)
    data = 0.5 + 0.06 * waves
    return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(data.astype(np.float32))}
