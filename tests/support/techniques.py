"""The table of techniques, which must have the mean of ``path``, and of the tests of each.

A new technique takes one row, in ``camera_techniques.py`` or ``splat_techniques.py``. ``make test``
runs the tests in ``checks``; tests that are only in ``thorough`` are marked ``slow``, and
``.ci/run`` runs them after the others.
"""

from __future__ import annotations

import pytest

from tests.support.camera_techniques import CAMERA_TECHNIQUES
from tests.support.splat_techniques import SPLAT_TECHNIQUES
from tests.support.technique import Technique

TECHNIQUES: dict[str, Technique] = {**CAMERA_TECHNIQUES, **SPLAT_TECHNIQUES}

#: The integrator to compare with.
REFERENCE = Technique("path", draws_like_path=True)

DEFAULTS = [name for name, technique in TECHNIQUES.items() if technique.is_plugin]
#: The kernels of light paths, and of the seven maps of ``swarm_path``, take seconds to compile: the
#: tests of these plugins are slow.
EACH_PLUGIN = [
    pytest.param(name, marks=pytest.mark.slow)
    if TECHNIQUES[name].makes_splats or name == "swarm_path" else name
    for name in DEFAULTS
]  # fmt: skip
FOLLOWERS = [name for name, technique in TECHNIQUES.items() if technique.draws_like_path]


def pairs(*columns: str) -> list:
    """Parameters of a test: the values of ``columns`` of :class:`Checks`, and the technique's name.
    Values that are only in ``thorough`` are marked ``slow``."""
    found = []
    for name, technique in TECHNIQUES.items():
        quick = technique.checks.combinations(columns)
        found += [pytest.param(*values, name) for values in quick]
        found += [
            pytest.param(*values, name, marks=pytest.mark.slow)
            for values in technique.thorough.combinations(columns)
            if values not in quick
        ]
    return found
