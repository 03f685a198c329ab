"""Renders with a timeout plan their pilots for the samples that fit, and passes of all lengths
share their kernels."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import pytest
from conftest import ROOT

from mitsuba_ext.rendering import pace, time_budget
from mitsuba_ext.rendering import render as rendering

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def passes(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, bool]]:
    """Of each pass: its samples per pixel, and whether it compiled a kernel."""
    taken, run_pass = [], rendering.Job._run_pass

    def run(job, stage, spp):
        taken.append((spp, run_pass(job, stage, spp)))
        return taken[-1][1]

    monkeypatch.setattr(rendering.Job, "_run_pass", run)
    return taken
