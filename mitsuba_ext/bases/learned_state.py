"""What a render saves of what it has learned, and what it loads: the parameters ``save_learned``,
``load_learned`` and ``keep_learned``."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi

from ..planning import kept_learning, learned_file
from ..planning.learned_file import LearnedFile
from ..planning.planner import Saver
from ..planning.technique import ParameterReader
from ..rendering.request import Request
from ..util.errors import InputError
from ..util.stored_arrays import StoredArrays


@dataclass
class LearnedState:
    """Where an integrator keeps what it learns.

    ``made_by``, a parameter of the methods, is on what learned states depend besides the scene
    (:class:`LearnedFile`).

    Attributes:
        plugin: The integrator's name.
        save, load: Names of files; empty for none.
        keep: Whether later renders of this process use it.
    """

    plugin: str
    save: str = ""
    load: str = ""
    keep: bool = False

    @classmethod
    def read(cls, plugin: str, read: ParameterReader) -> LearnedState:
        """Reads the parameters of an integrator that learns.

        Raises:
            TypeError, ValueError: A parameter is wrong, or two of them exclude each other.
        """
        found = cls(
            plugin, read("save_learned", ""), read("load_learned", ""), read("keep_learned", False)
        )
        for key, is_given in (("save_learned", found.save), ("keep_learned", found.keep)):
            if found.load and is_given:
                raise ValueError(
                    f'"{plugin}": with "load_learned" nothing is learned: leave "{key}" out'
                )
        return found

    def parameters(self) -> dict[str, Any]:
        """The parameters that are given, by name."""
        named = {
            "save_learned": self.save, "load_learned": self.load, "keep_learned": self.keep
        }  # fmt: skip
        return {key: value for key, value in named.items() if value}

    @property
    def has_file(self) -> bool:
        """Whether parameters name a file."""
        return bool(self.save or self.load)

    def target(self, request: Request) -> str:
        """The file in which a render saves what it learns; empty for none."""
        return request.save_learned or self.save

    def check_target(self, request: Request) -> None:
        """
        Raises:
            ValueError: This file cannot be written.
        """
        if target := self.target(request):
            check_target(self.plugin, "save_learned", target)

    def loads(self, request: Request) -> bool:
        """Whether a render loads what another one has learned."""
        return bool(request.load_learned or self.load)

    def loaded(self, request: Request, made_by: str) -> dict[str, StoredArrays]:
        """The arrays that a render loads.

        Raises:
            FileNotFoundError: The file does not exist.
            ValueError: It was made for another scene, or by another integrator.
        """
        name = request.load_learned or self.load
        file = file_of(self.plugin, "load_learned", name, request.scene, made_by)
        if (stored := file.load()) is None:
            raise FileNotFoundError(
                f'{file.where} names "{file.path}", which does not exist: give it a file that '
                f'"save_learned" wrote'
            )
        return stored.parts()

    def savers(self, request: Request, made_by: str, pilot_spp: int) -> list[Saver]:
        """The functions that save what is learned from ``pilot_spp`` samples per pixel, in a file
        and for this process."""
        scene, savers = request.scene, []
        if target := self.target(request):
            savers.append(file_of(self.plugin, "save_learned", target, scene, made_by).save)
        if self.keep and pilot_spp:
            savers.append(functools.partial(kept_learning.put, scene, made_by, pilot_spp))
        return savers


def file_of(plugin: str, key: str, name: str, scene: mi.Scene, made_by: str) -> LearnedFile:
    """The file that the parameter ``key`` of a plugin names; ``made_by`` is explained in
    :class:`LearnedFile`."""
    return LearnedFile(Path(name), scene, made_by, f'"{plugin}": the parameter "{key}"')


def check_target(
    plugin: str,
    key: str,
    name: str,
    check: Callable[[Path], None] = learned_file.check_target,
) -> None:
    """
    Raises:
        ValueError: The file that the parameter ``key`` names cannot be written, or ``check`` finds
            that there is one of another kind.
    """
    try:
        check(Path(name))
    except InputError as error:
        raise ValueError(f'"{plugin}": "{key}": {error}') from None
