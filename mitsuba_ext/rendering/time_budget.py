"""Computes how many samples fit into the time of a render.

The number of samples of a stage is computed from the times of its first passes, before the others
are rendered. The clock never ends a stage: stopping by the clock would be biased towards samples
that are fast. Each stage begins with a short pass that measures the speed; it is repeated until one
compiles nothing.
"""

from __future__ import annotations

import time

#: Approximate number of samples of a short pass; fewer would take as long.
_SHORT_PASS = 1 << 16

#: Largest share of all samples for pilot passes. Their samples have the most variance, and learning
#: from them takes additional time.
_PILOT_SHARE = 0.25

#: Fraction of the time left that the second pass of the last stage takes. It measures the speed
#: more precisely than the short pass.
_SECOND_SHARE = 0.25


#: Largest share of the time that is left for pilots, for compiling their kernels, and for learning
#: from them.
LEARNING_SHARE = 1 / 3


class TimeBudget:
    """The time of one render.

    Parameters:
        timeout: Seconds; 0 or less for no limit.
        start: Start of the render, by ``time.perf_counter``.
        pixel_count: Number of pixels of the film.
        pilot_spp: Samples per pixel of all pilot passes without a limit.

    Attributes:
        is_limited: Is there a limit?
        end: End of the render, by ``time.perf_counter``.
        short: Samples per pixel of a short pass.
        pilot_factor: Fraction of the pilots' samples that are taken; ``None`` until the speed is
            known.
    """

    def __init__(self, timeout: float, start: float, pixel_count: int, pilot_spp: int) -> None:
        self.is_limited = timeout > 0
        self.end = start + timeout
        self._learning_end = start + LEARNING_SHARE * timeout
        self._pilot_pace = 0.0
        self.short = max(1, _SHORT_PASS // pixel_count)
        self.pilot_spp = pilot_spp
        self.pilot_factor: float | None = None

    def ends_learning(self, samples: int) -> bool:
        """Has learning taken its share of the time, or would it with another pilot of ``samples``
        samples per pixel?"""
        expected = time.perf_counter() + samples * self._pilot_pace
        return self.is_limited and expected > self._learning_end

    def stage(self, samples: int, taken: int, is_last: bool) -> StageBudget:
        """The budget of a stage.

        Parameters:
            samples: Samples per pixel of the stage without a limit.
            taken: Samples per pixel of the stages before.
            is_last: Is it the last stage? The others are pilots.
        """
        if not self.is_limited:
            return StageBudget(samples, samples)
        if is_last:
            return _LastStageBudget(self, samples)
        return _PilotBudget(self, samples, taken)


class StageBudget:
    """The samples of a stage, without a limit.

    Attributes:
        samples: Samples per pixel to take, as far as known.
        longest: Largest number of samples per pixel in the next pass.
        is_open: Can the number of samples still change?
    """

    is_open = False

    def __init__(self, samples: int, longest: int) -> None:
        self.samples, self.longest = samples, longest

    def passed(self, spp: int, done: int, seconds: float) -> None:
        """Records that a pass of ``spp`` samples per pixel, which compiled nothing, took
        ``seconds``; the stage has taken ``done`` samples per pixel so far."""


class _PilotBudget(StageBudget):
    """The samples of a pilot. The speed of the first pass decides the fraction of all pilots."""

    def __init__(self, whole: TimeBudget, samples: int, taken: int) -> None:
        super().__init__(samples, whole.short)
        self._whole, self._wanted, self._taken = whole, samples, taken
        self._fit()

    def passed(self, spp: int, done: int, seconds: float) -> None:
        whole = self._whole
        whole._pilot_pace = seconds / spp
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
    """The samples of the last stage: a short pass, a pass of a quarter of the time left, and the
    rest."""

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
