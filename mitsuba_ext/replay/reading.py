"""Makes paths from the rows of a log."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .path_log import CONNECTIONS, EMISSION, IN_MEDIUM, JOINED, MERGES, SURVIVAL, VERTEX, Row, Rows
from .paths import FoundLight, Numbers, PathVertex

_TECHNIQUES = {
    EMISSION: "emission", JOINED: "light path", **dict.fromkeys(MERGES, "merge"),
    **dict.fromkeys(CONNECTIONS, "connection"),
}  # fmt: skip

#: The words for each lobe of a BSDF.
_LOBES = {
    "Null": "straight through", "DiffuseReflection": "diffuse reflection",
    "DiffuseTransmission": "diffuse transmission", "GlossyReflection": "glossy reflection",
    "GlossyTransmission": "glossy transmission", "DeltaReflection": "delta reflection",
    "DeltaTransmission": "delta transmission",
}  # fmt: skip


class PathReader:
    """Makes paths from the rows of a log, and finds the names of what they meet.

    Parameters:
        scene: The scene, whose ids become names.
    """

    def __init__(self, scene: mi.Scene) -> None:
        self._names: dict[tuple[str, int], str] = {}
        self._lights = {id(s.emitter()): _name(s) for s in scene.shapes() if s.emitter()}

    def path(self, rows: Rows) -> tuple[tuple[PathVertex, ...], tuple[FoundLight, ...]]:
        """The vertices of the path whose rows these are, and the light that belongs to none."""
        # Several vertices have the same depth where all except the last are index-matched
        vertices: list[dict[str, Any]] = []
        last_of: dict[int, dict[str, Any]] = {}
        for row in rows.of_kind(VERTEX):
            vertices.append({**self._vertex(row), "lights": []})
            last_of[int(row["depth"])] = vertices[-1]
        for row in rows.of_kind(SURVIVAL):
            if (before := last_of.get(int(row["depth"]) - 1)) is not None:
                before["survival"] = float(row["weight"][0])
        loose, environment = [], None
        for kind in _TECHNIQUES:
            for row in rows.of_kind(kind):
                light, vertex = self._light(kind, row), last_of.get(int(row["depth"]))
                if kind == EMISSION and self._is_infinite(row):
                    if environment is None:
                        environment = {**self._environment(row), "lights": []}
                    vertex = environment
                (loose if vertex is None else vertex["lights"]).append(light)
        vertices += [environment] if environment else []
        if vertices:
            vertices[-1] |= {"event": "end", "pdf": None, "survival": 1.0}
        made = (PathVertex(**{**each, "lights": tuple(each["lights"])}) for each in vertices)
        return tuple(made), tuple(loose)

    def _vertex(self, row: Row) -> dict[str, Any]:
        flags, is_medium = int(row["flags"]), bool(row["flags"] & np.uint32(IN_MEDIUM))
        names = [text for name, text in _LOBES.items() if _has(flags, name)]
        return {
            "kind": "medium" if is_medium else "surface",
            "position": _numbers(row["p"]),
            "normal": None if is_medium else _numbers(row["n"]),
            "shape": "" if is_medium else self._named(mi.ShapePtr, row["object"]),
            "bsdf": "" if is_medium else self._named(mi.BSDFPtr, row["bsdf"]),
            "event": "scattering" if is_medium else " or ".join(names) or "absorption",
            "throughput": self._throughput(row),
            "pdf": float(row["pdf"][0]),
        }

    def _environment(self, row: Row) -> dict[str, Any]:
        return {
            "kind": "environment", "position": _numbers(row["n"]), "normal": None, "shape": "",
            "bsdf": "", "event": "end", "throughput": self._throughput(row), "pdf": None,
        }  # fmt: skip

    def _light(self, kind: int, row: Row) -> FoundLight:
        rgb, mis = _numbers(row["rgb"]), float(row["weight"][0])
        if kind == JOINED or kind in MERGES:
            count = int(row["flags"]) if kind == JOINED else None
            return FoundLight(_TECHNIQUES[kind], rgb, mis=mis, light_vertices=count)
        is_infinite = self._is_infinite(row)
        return FoundLight(
            _TECHNIQUES[kind], rgb, self._named(mi.EmitterPtr, row["object"]),
            _numbers(row["n" if is_infinite else "p"]), is_infinite, float(row["pdf"][0]),
            float(row["other_pdf"][0]), mis,
        )  # fmt: skip

    def _is_infinite(self, row: Row) -> bool:
        """Whether the light of this row is infinitely far away."""
        emitter = _object(mi.EmitterPtr, row["object"])
        return emitter is not None and bool(int(emitter.flags()) & int(mi.EmitterFlags.Infinite))

    def _throughput(self, row: Row) -> Numbers:
        return _numbers(row["throughput"][: len(mi.Spectrum())])

    def _named(self, kind: type, number: np.uint32) -> str:
        key = (kind.__name__, int(number))
        if key not in self._names:
            found = _object(kind, number)
            name = "" if found is None else self._lights.get(id(found)) or _name(found)
            self._names[key] = name
        return self._names[key]


def _has(flags: int, name: str) -> bool:
    return bool(flags & int(getattr(mi.BSDFFlags, name)))


def _object(kind: type, number: np.uint32) -> Any:
    """The object of a number of Dr.Jit's registry; ``None`` for 0."""
    return dr.reinterpret_array(kind, mi.UInt32(int(number)))[0]


def _name(found: Any) -> str:
    """The id that the scene gives an object, or else its class."""
    name = found.id()
    if name and not name.startswith("_unnamed"):
        return name
    return getattr(found, "name", None) or found.class_name() or type(found).__name__


def _numbers(values: Any) -> Numbers:
    return tuple(float(value) for value in values)
