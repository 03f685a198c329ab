"""Nested integrators and class names of integrators, both of this package and of Mitsuba."""

from __future__ import annotations

import mitsuba as mi


def with_nested(integrator: mi.Integrator) -> list[mi.Integrator]:
    """An integrator, and the integrators nested in it at any depth."""
    found = [integrator]
    for child in _children(integrator):
        found += with_nested(child)
    return found


def class_name(integrator: mi.Integrator) -> str:
    """The name of the integrator's class, which may be written in Python or in C++."""
    name, python_class = integrator.class_name(), type(integrator)
    # Mitsuba does not know Python classes: it returns the name of the C++ base class
    is_python = name in {base.__name__ for base in python_class.__mro__}
    return python_class.__name__ if is_python else name


def refuse_checkpoint(name: str, nested: mi.Integrator) -> None:
    """
    Raises:
        ValueError: An integrator that is nested in the plugin ``name`` has the parameter
            ``checkpoint``: a part of a render cannot be saved.
    """
    for each in with_nested(nested):
        if getattr(each, "checkpoint", ""):
            raise ValueError(
                f'"{name}": the parameter "checkpoint" of the nested "{each.name}" has no effect: '
                f"give it to the outermost integrator, if that is one of ours"
            )


def _children(integrator: mi.Integrator) -> list[mi.Integrator]:
    # Our integrators keep a nested one in this attribute, and do not traverse it
    nested = getattr(integrator, "nested", None)
    if isinstance(nested, mi.Integrator):
        return [nested]

    # Defined here because the base class exists only once a variant is selected
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
