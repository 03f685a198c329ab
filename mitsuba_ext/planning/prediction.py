"""What a pilot has found out about a decision."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Prediction:
    """What pilots predict of a learned decision, relative to the decision of ``path``.

    Attributes:
        variance: The variance with it, divided by the variance without it.
        time: The time of a sample with it, divided by the time without it.
        error: The standard error of the logarithm of ``variance``.
        share: The share of all pilots' samples from which it was found. A small one is a trial: it
            tells whether learning should continue.
        grows: Whether more samples make the decision better.
        overhead: What it takes besides the time of a sample, as a share of that.
    """

    variance: float
    time: float
    error: float = 0.0
    share: float = 1.0
    grows: bool = False
    overhead: float = 0.0

    @property
    def efficiency(self) -> float:
        """1 / (variance · time)."""
        return 1 / (max(self.variance, 1e-3) * self.time * (1 + self.overhead))


@dataclass(frozen=True)
class Effect:
    """The effect of a learned decision, relative to ``path``, as far as pilots can tell.

    Attributes:
        is_kept: Whether the last stage uses it.
        variance: The variance of the last stage with it, divided by the variance without it;
            ``None`` where it was not measured. For a decision that is not kept, this and ``time``
            are the reason.
        time: The time of the last stage with it, divided by the time without it; ``None`` where it
            was not measured.
        about: What else was chosen.
    """

    is_kept: bool
    variance: float | None = None
    time: float | None = None
    about: dict[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """All that is known, as numbers, Booleans and texts."""
        figures = {"variance": self.variance, "time": self.time}
        known = {key: x for key, x in figures.items() if x is not None} | self.about
        return {"is_kept": self.is_kept, **{key: _plain(x) for key, x in known.items()}}


def _plain(x: Any) -> Any:
    """A number of NumPy's as one of Python's; those that are not whole, with four digits."""
    x = x.item() if hasattr(x, "item") else x
    return float(f"{x:.4g}") if isinstance(x, float) else x
