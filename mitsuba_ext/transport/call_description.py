"""Everything that the kernels of a frozen function (``frozen.py``) depend on."""

from __future__ import annotations

import enum
import functools
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene.parameter_values import values_of

#: Values that are their own description.
VALUES = (int, float, str, bytes, bool, type(None), enum.Enum, range)

#: Sensors of Mitsuba 3.9.1 that hold arrays but do not report them to Dr.Jit.
SENSORS_WITH_HIDDEN_ARRAYS = frozenset({"ThinLensCamera", "OrthographicCamera"})

#: Reconstruction filters that are known by their radius.
_FILTERS = frozenset({"BoxFilter", "TentFilter", "GaussianFilter", "CatmullRomFilter",
                      "LanczosSincFilter"})  # fmt: skip


class UndescribedError(Exception):
    """An argument cannot be compared with the same argument of an earlier call. The message names
    the argument."""


def address(thing: mi.Object) -> int:
    """Names an object of Mitsuba while it lives."""
    return thing.ptr


def sensor_name(sensor: mi.Sensor) -> Any:
    """What kernels depend on besides the parameters of a sensor. Perspective cameras with equal
    films share recordings, because an optimization may have one camera for each of a hundred
    photographs. (Dr.Jit still records each of them if the scene has a sensor of its own.) Other
    sensors are named by their address, and so are cameras with stratified samplers, whose options
    nothing reports."""
    film = sensor.film()
    kinds = sensor.class_name(), film.class_name(), sensor.sampler().class_name()
    if (
        kinds != ("PerspectiveCamera", "HDRFilm", "IndependentSampler")
        or sensor.get_medium() is not None
        or film.rfilter().class_name() not in _FILTERS
    ):
        return address(sensor)
    shutter = sensor.shutter_open(), sensor.shutter_open_time()
    return *kinds, str(film), filter_name(film.rfilter()), *shutter


def filter_name(rfilter: mi.ReconstructionFilter) -> Any:
    """Distinguishes reconstruction filters."""
    if rfilter.class_name() in _FILTERS:
        return rfilter.class_name(), rfilter.radius()
    return address(rfilter)


def literals(value: Any) -> Any:
    """The numbers of which a kernel consists where it reads ``value``; ``None`` for others."""
    if dr.depth_v(value) > 1:
        return tuple(map(literals, value))
    is_literal = not dr.is_tensor_v(value) and value.state == dr.VarState.Literal
    return value[0] if is_literal else None


def constants(parameters: mi.SceneParameters) -> tuple:
    """The parameters that are not arrays: kernels contain them, and users may change them."""
    # The types of most arrays are known without a look at the arrays, which takes longer
    keys = (
        key for key, (_, kind, *_) in parameters.properties.items()
        if kind is None or not dr.is_jit_v(kind)
    )  # fmt: skip
    return tuple(
        (key, value if isinstance(value, VALUES) else str(value))
        for key, value in values_of(parameters, keys)
        if not _holds_arrays(value)
    )


def _holds_arrays(value: Any) -> bool:
    # Transforms of textures are numbers; transforms of cameras and shapes are arrays
    names = getattr(type(value), "DRJIT_STRUCT", ())
    return dr.is_jit_v(value) or any(_holds_arrays(getattr(value, name)) for name in names)


class CallDescription:
    """Describes arguments by everything that matters to kernels, except the contents of arrays.

    Parameters:
        scene: The scene that is rendered.
        own: Addresses of its objects.
        any_width: Whether the widths of arrays are left out.

    Attributes:
        arrays: The arrays, and objects that hold arrays, in the order in which they were met.
        held: Objects outside of the scene that are named by their address.
    """

    def __init__(self, scene: mi.Scene, own: frozenset[int], any_width: bool) -> None:
        self._scene, self._own, self._any_width = scene, own, any_width
        self._met: dict[int, int] = {}
        # Keeps objects alive, so that no new one gets the id of an earlier one
        self._kept_alive: list[Any] = []
        self.arrays: list[Any] = []
        self.held: dict[int, Any] = {}

    def of(self, thing: Any) -> Any:
        """The description of one thing: a value that can be compared and hashed."""
        if isinstance(thing, VALUES):
            # True is 1, and 1 is 1.0
            return type(thing), thing
        if id(thing) in self._met:
            return "met", self._met[id(thing)]
        self._met[id(thing)] = len(self._met)
        self._kept_alive.append(thing)
        kind = type(thing)
        if dr.is_jit_v(kind) and dr.is_array_v(kind):
            if dr.width(thing) == 0:
                return kind, "empty"
            self.arrays.append(thing)
            return kind, self._widths(thing)
        if isinstance(thing, (list, tuple)):
            return kind, tuple(self.of(part) for part in thing)
        if isinstance(thing, dict):
            return kind, tuple((self.of(key), self.of(value)) for key, value in thing.items())
        if isinstance(thing, (set, frozenset)) and all(isinstance(x, VALUES) for x in thing):
            return kind, frozenset(thing)
        if isinstance(thing, np.ndarray):
            return thing.shape, thing.dtype.str, thing.tobytes()
        if isinstance(thing, (np.number, np.bool_)):
            return kind, thing.item()
        if isinstance(thing, type):
            return thing
        if isinstance(thing, functools.partial):
            return kind, self.of(thing.func), self.of(thing.args), self.of(thing.keywords)
        if callable(thing) and hasattr(thing, "__code__"):
            return self._function(thing)
        if isinstance(thing, mi.Object):
            return self._object(thing)
        if hasattr(kind, "DRJIT_STRUCT"):
            self.arrays.append(thing)
            parts = (self._widths(getattr(thing, name)) for name in kind.DRJIT_STRUCT)
            return kind, tuple(parts)
        if kind.__module__.partition(".")[0] in ("mitsuba", "drjit") and not hasattr(
            thing, "__dict__"
        ):
            return kind, str(thing)
        if hasattr(kind, "kernel_state"):
            return kind, self.of(thing.kernel_state())
        if isinstance(thing, slice):
            return kind, thing.start, thing.stop, thing.step
        if hasattr(thing, "__dict__"):
            return kind, tuple((key, self.of(value)) for key, value in vars(thing).items())
        raise UndescribedError(f'a "{kind.__module__}.{kind.__qualname__}"')

    def _widths(self, thing: Any) -> Any:
        if self._any_width:
            # Scalars stay scalars
            return dr.width(thing) == 1
        if dr.is_tensor_v(thing):
            return dr.shape(thing)
        return dr.width(thing)

    def _function(self, function: Callable) -> Any:
        owner = getattr(function, "__self__", None)
        cells = [cell.cell_contents for cell in function.__closure__ or ()]
        defaults = function.__defaults__
        return function.__code__, self.of(owner), self.of(cells), self.of(defaults)

    def _object(self, thing: mi.Object) -> Any:
        if type(thing).__module__.partition(".")[0] != "mitsuba":
            raise UndescribedError(f'a "{type(thing).__name__}", which is written in Python')
        if thing.class_name() in SENSORS_WITH_HIDDEN_ARRAYS:
            raise UndescribedError(f'a "{thing.class_name()}", whose arrays are not all known')
        self.arrays.append(thing)
        if thing is self._scene:
            return "scene"
        if isinstance(thing, mi.Sampler):
            # Kernels contain the number of strata
            is_stratified = thing.class_name() != "IndependentSampler"
            count = thing.sample_count() if is_stratified else None
            return type(thing), thing.class_name(), thing.wavefront_size(), count
        if isinstance(thing, mi.ImageBlock):
            return (
                type(thing), tuple(thing.size()), tuple(thing.offset()), thing.channel_count(),
                thing.coalesce(), thing.normalize(), thing.border_size(),
                filter_name(thing.rfilter()) if thing.rfilter() is not None else None,
                thing.warn_negative(), thing.warn_invalid(),
            )  # fmt: skip
        name = sensor_name(thing) if isinstance(thing, mi.Sensor) else address(thing)
        if isinstance(name, int) and name not in self._own:
            self.held[name] = thing
        return type(thing), name
