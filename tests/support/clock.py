"""Clocks that only the code under test moves."""

from __future__ import annotations

import pytest

from mitsuba_ext.rendering import pace
from mitsuba_ext.rendering import render as rendering


class Clock:
    """Stands in for the module ``time``, on a machine that can become slower."""

    def __init__(self) -> None:
        self.now = 0.0
        self.slowness = 1.0

    def perf_counter(self) -> float:
        return self.now


class PassClock:
    """A clock that only passes advance: each sample per pixel takes a tenth of a second."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, compiling: int = 0) -> None:
        self.now, self.compiling = 0.0, compiling
        run_pass = rendering.Job.run_pass

        def run_on_clock(job, stage, spp):
            run_pass(job, stage, spp)
            self.compiling -= 1
            self.now += 5.0 if self.compiling >= 0 else 0.1 * spp
            return self.compiling >= 0

        monkeypatch.setattr(rendering.Job, "run_pass", run_on_clock)
        monkeypatch.setattr(rendering.time, "perf_counter", lambda: self.now)
        monkeypatch.setattr(pace, "_SHORT_PASS", 1)
