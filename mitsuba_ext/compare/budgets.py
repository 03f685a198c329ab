"""The budget of each run of a comparison: samples, seconds, or an error to reach."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real

from ..util.errors import InputError

#: The initial samples per pixel of ``until``. With fewer, an integrator may have no pilot pass.
_FIRST_SPP = 8


@dataclass(frozen=True)
class Budget:
    """A budget, made by :func:`equal_samples`, :func:`equal_time`, :func:`sweep` or :func:`until`.

    Attributes:
        kind: ``spp``, ``time``, ``sweep`` or ``until``.
        values: The levels: numbers of samples (``spp``, ``sweep``) or seconds (``time``); for
            ``until``, the relMSE to reach.
    """

    kind: str
    values: tuple[float, ...]

    @property
    def is_time(self) -> bool:
        return self.kind == "time"

    @property
    def target(self) -> float | None:
        """The relMSE that ``until`` must reach; ``None`` for other budgets."""
        return self.values[0] if self.kind == "until" else None

    def level(self, index: int) -> float:
        """The ``index``-th level; the levels of ``until`` double each time, without limit."""
        return _FIRST_SPP << index if self.kind == "until" else self.values[index]

    def __str__(self) -> str:
        if self.kind == "until":
            return f"until relMSE {self.values[0]:g}"
        text = ", ".join(f"{value:g}" for value in self.values)
        return f"{text} {'s' if self.is_time else 'spp'}"


def equal_samples(spp: int) -> Budget:
    """``spp`` samples per pixel for every run."""
    return Budget("spp", (_count(spp),))


def equal_time(seconds: float) -> Budget:
    """As many samples as fit into ``seconds``, including learning but not compilation."""
    return Budget("time", (_positive(seconds, "seconds"),))


def sweep(counts: list[int] | tuple[int, ...]) -> Budget:
    """Several numbers of samples per pixel, for convergence plots."""
    values = tuple(sorted({_count(spp) for spp in counts}))
    if not values:
        raise InputError("a sweep needs at least one number of samples")
    return Budget("sweep", values)


def until(relmse: float) -> Budget:
    """Doubles the samples, from 8 per pixel, until the mean relMSE is at most ``relmse``."""
    return Budget("until", (_positive(relmse, "relMSE"),))


def _count(value: int) -> int:
    if isinstance(value, bool) or not isinstance(value, Real) or value != value // 1 or value < 1:
        raise InputError(f"samples per pixel must be whole and at least 1, found {value!r}")
    return int(value)


def _positive(value: float, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, Real) or not 0 < value < math.inf:
        raise InputError(f"{name} must be positive, found {value!r}")
    return float(value)
