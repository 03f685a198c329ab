"""The integrators that a comparison compares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ..inputs.specifications import NamedIntegrator, Specification, make_named
from ..scene.nesting import with_nested
from ..util.errors import InputError
from .runs import Run


@dataclass
class Contender:
    """An integrator of an experiment, and its runs.

    Attributes:
        named: The integrator, its label, name and parameters.
        runs: Its runs, in the order in which they were measured.
        compile_seconds: The time to compile or load the kernels, without tracing.
        error: Why there are no (more) runs; empty if there was no error.
        traceback: The error's traceback, for authors of integrators.
        notes: Remarks for readers of the figures.
    """

    named: NamedIntegrator
    runs: list[Run] = field(default_factory=list)
    compile_seconds: float = 0.0
    error: str = ""
    traceback: str = ""
    notes: list[str] = field(default_factory=list)
    _zero_radiance: float | None = None  # measured separately if the integrator does not count it
    _pace: float | None = None  # seconds per sample per pixel
    _plans: bool = False  # whether it plans for the time of a run
    _is_prepared: bool = False

    @property
    def label(self) -> str:
        return self.named.label

    def levels(self) -> list[float]:
        """The levels that have runs, ascending."""
        return sorted({run.level for run in self.runs})

    def at(self, level: float) -> list[Run]:
        """The runs of a level, in the order of their rounds."""
        return sorted((r for r in self.runs if r.level == level), key=lambda run: run.round)


def make_all(
    integrators: Sequence[Specification] | Mapping[str, Specification],
    inherited: Mapping[str, object] | None = None,
) -> list[NamedIntegrator]:
    """Makes the integrators of a comparison.

    Raises:
        InputError: No integrator was given, one cannot be made, a label is empty, or two labels are
            the same.
    """
    if isinstance(integrators, Mapping) and "type" not in integrators:
        pairs = list(integrators.items())
    elif isinstance(integrators, (str, Path, Mapping)):
        pairs = [(None, integrators)]
    else:
        pairs = [(None, specification) for specification in integrators]
    if not pairs:
        raise InputError("no integrator was given")
    if any(label is not None and not str(label).strip() for label, _specification in pairs):
        raise InputError("the label of an integrator is empty")
    made = [make_named(specification, inherited, label) for label, specification in pairs]
    labels = [named.label for named in made]
    for label in labels:
        if labels.count(label) > 1:
            raise InputError(
                f'the integrator "{label}" is given twice; for more runs of it, increase --seeds'
            )
    for named in made:
        if any(getattr(each, "checkpoint", "") for each in with_nested(named.integrator)):
            raise InputError(
                f'the integrator "{named.label}" has the parameter "checkpoint", with which it '
                f"does not render everything: leave it out"
            )
    return made
