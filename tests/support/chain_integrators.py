"""Integrators that render with chains, with the settings of the tests."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

#: All light is left to the chains.
ALONE = {"direct_samples": -1}


def pssmlt(max_depth: int = 4, **parameters: Any) -> Any:
    """Chains around the walk: one kernel for all of their mutations."""
    own = {"bidirectional": False, "max_depth": max_depth}
    return mi.load_dict({"type": "pssmlt", **own, **parameters})


#: Light that ``path`` finds rarely.
GLASS_BALL = {"type": "sphere", "center": [-0.2, -0.8, 0.4], "radius": 0.3,
              "bsdf": {"type": "dielectric"}}  # fmt: skip


def erpt(max_depth: int = 4, **parameters: Any) -> Any:
    defaults = {"luminance_samples": 4096, "chain_length": 20}
    return mi.load_dict({"type": "erpt", "max_depth": max_depth, **defaults, **parameters})
