"""How many samples fit into the time that a render has.

The number of samples of a stage is fixed by the times of its first passes, before the others are
rendered. The clock never ends a stage: an image that ends when the clock says so prefers samples
that are fast. Each stage begins with a short pass, which is repeated until one has compiled
nothing: it tells the speed.
"""

from __future__ import annotations

import time

#: Samples of a short pass, about: fewer would take as long.
_SHORT_PASS = 1 << 16

#: Share of all samples that pilots may take. They are the least useful ones, and learning from them
#: takes time besides.
_PILOT_SHARE = 0.25

#: Share of the time left that the second pass of the last stage takes: it tells the speed better
#: than the short one does.
_SECOND_SHARE = 0.25


class TimeBudget:
    """The time of one render.

    Parameters:
        timeout: Seconds; 0 or less for no limit.
        start: When they began, by ``time.perf_counter``.
        pixel_count: Of the film.
        pilot_spp: Samples per pixel that all pilots would take without a limit.

    Attributes:
        is_limited: Is there a limit?
        end: When it is reached, by the same clock.
        short: Samples per pixel of a short pass.
        pilot_factor: By how much pilots are cut short; ``None`` until the speed is known.
    """

    def __init__(self, timeout: float, start: float, pixel_count: int, pilot_spp: int) -> None:
        self.is_limited = timeout > 0
        self.end = start + timeout
        self.short = max(1, _SHORT_PASS // pixel_count)
        self.pilot_spp = pilot_spp
        self.pilot_factor: float | None = None

    def stage(self, samples: int, taken: int, is_last: bool) -> StageBudget:
        """That of a stage which would take ``samples`` samples per pixel without a limit, after
        ``taken`` ones of earlier stages."""
        if not self.is_limited:
            return StageBudget(samples, samples)
        if is_last:
            return _LastStageBudget(self, samples)
        return _PilotBudget(self, samples, taken)


class StageBudget:
    """The samples of a stage, without a limit.

    Attributes:
        samples: Samples per pixel to take, as far as it is known.
        longest: Length of the next pass, at most.
        is_open: Can the number of samples still change?
    """

    is_open = False

    def __init__(self, samples: int, longest: int) -> None:
        self.samples, self.longest = samples, longest

    def passed(self, spp: int, done: int, seconds: float) -> None:
        """A pass of ``spp`` samples, which compiled nothing, took so long; the stage has ``done``
        samples by now."""


class _PilotBudget(StageBudget):
    """All pilots together are cut short when the speed of the first pass is known."""

    def __init__(self, whole: TimeBudget, samples: int, taken: int) -> None:
        super().__init__(samples, whole.short)
        self._whole, self._wanted, self._taken = whole, samples, taken
        self._fit()

    def passed(self, spp: int, done: int, seconds: float) -> None:
        whole = self._whole
        if whole.pilot_factor is None:
            left = max(0.0, whole.end - time.perf_counter()) * spp / seconds
            most = _PILOT_SHARE * (self._taken + done + left)
            whole.pilot_factor = min(1.0, most / whole.pilot_spp)
            self._fit()

    def _fit(self) -> None:
        factor = self._whole.pilot_factor
        self.is_open = factor is None
        if factor is not None:
            self.samples = self.longest = max(1, int(factor * self._wanted))


class _LastStageBudget(StageBudget):
    """A short pass, one of a quarter of the time left, and the rest."""

    is_open = True

    def __init__(self, whole: TimeBudget, samples: int) -> None:
        super().__init__(samples, whole.short)
        self._whole, self._wanted, self._measured = whole, samples, 0

    def passed(self, spp: int, done: int, seconds: float) -> None:
        if not self.is_open:
            return
        left = round(max(0.0, self._whole.end - time.perf_counter()) * spp / seconds)
        self.samples = min(self._wanted, done + left)
        self._measured += 1
        self.is_open = self._measured < 2 and left > 0
        self.longest = max(1, int(_SECOND_SHARE * left)) if self.is_open else self._wanted
