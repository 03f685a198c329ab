"""Integrators inside of integrators."""

from __future__ import annotations

import mitsuba as mi


def with_nested(integrator: mi.Integrator) -> list[mi.Integrator]:
    """An integrator, and those that are nested in it at any depth."""
    found = [integrator]
    for child in _children(integrator):
        found += with_nested(child)
    return found


def _children(integrator: mi.Integrator) -> list[mi.Integrator]:
    if type(integrator).__module__.split(".")[0] != "mitsuba":
        nested = getattr(integrator, "nested", None)  # as ours call it
        return [nested] if isinstance(nested, mi.Integrator) else []

    # The base class is known once a variant is selected
    class Collector(mi.TraversalCallback):
        def __init__(self) -> None:
            super().__init__()
            self.found: list[mi.Integrator] = []

        def put(self, _name: str, value: object, _flags: int) -> None:
            if isinstance(value, mi.Integrator):
                self.found.append(value)

    collector = Collector()
    integrator.traverse(collector)
    return collector.found
