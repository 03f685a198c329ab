"""Functions that Dr.Jit traces once per scene, and launches again without Python.

Tracing a walk takes longer than running it for a few ten thousand samples: Dr.Jit traces each call
of a BSDF once for each BSDF of the scene. ``dr.freeze`` records the kernels of a function instead.
It handles arrays, and objects of Mitsuba that hold arrays. Everything else that a function depends
on is described (:class:`CallDescription`): the classes of our objects and the values of their
attributes, the parameters of the scene that are not arrays, the number of threads. A recording is
used again only where all of this is the same.

Nothing is recorded in four cases: in spectral variants, whose colour tables are not arguments of
any function; with a ``batch`` of sensors, which loads a table of them whenever it is traced; where
kernels call plugins that are written in Python, which may read arrays or free memory of NumPy while
they are traced (Dr.Jit ends the process in these two cases); and once the grid of a volume has
changed: Dr.Jit 1.5.0 may use the earlier grid in a recording, also in a new one. A function with an
argument that cannot be described is not frozen either: a sampler in Python, or a ``thinlens`` or an
``orthographic`` sensor, which do not report all their arrays to Dr.Jit. (With these, camera rays
are traced in each pass, and what follows is recorded.) The log says why (level ``Debug``). If
Dr.Jit cannot record a function, the render starts over, nothing more is recorded in that scene, and
the log says so (level ``Info``).

Nothing is recorded or replayed, either, while another thread is alive that may use Dr.Jit: a thread
that has rendered, or that is neither a daemon nor a timer. Functions are then traced. While Dr.Jit
1.5.0 records or replays, it holds its own lock when it calls Python, and may wait for a thread that
waits for that lock; it keeps the state of a replay in static variables, and releases the lock
wherever memory is allocated; and it reads and replaces the arrays of all objects that kernels can
call, including objects of other scenes. Processes hung, ended, or returned different images.

Rules for a frozen function:

- It does not assign attributes of its arguments; it changes only the contents of their arrays.
  (This is checked.)
- Other attributes of its arguments do not change between calls either, unless the argument has a
  method ``kernel_state``, which returns the attributes on which kernels depend.
- It reads no array on the host, and its results are arrays, or dataclasses, dicts, lists and tuples
  of these. (This is checked.)
- An array among its arguments is a literal in all calls or in none (``dr.opaque`` ensures that it
  is not). Dr.Jit compiles a literal into the kernel until its value changes: the first render of a
  scene would have other kernels, and its image would differ from the second one by rounding.
- A kernel as wide as one of the arguments reads an array of this width directly. For a kernel that
  only gathers, Dr.Jit infers the width from widths seen before, which fails where these change. All
  widths are therefore part of the description, except for functions declared with ``any_width``.
"""

from __future__ import annotations

import functools
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, is_dataclass
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi

from ..scene.mark import SceneMark
from ..scene.parameter_values import values_of
from ..startup import registry
from ..startup.garbage import garbage_left_alone
from .call_description import (
    VALUES,
    CallDescription,
    UndescribedError,
    address,
    constants,
    literals,
    sensor_name,
)

#: The largest number of scenes whose recordings are kept, and of recordings of each scene.
_MOST_SCENES, _MOST_RECORDINGS = 8, 256

#: Parts of Dr.Jit's messages when it cannot record (the second one on a GPU, where memory is
#: copied).
_OF_RECORDING = "frozen function", "record(): "


class NotRecordableError(RuntimeError):
    """Dr.Jit cannot record a function, which may already have changed its arguments."""


@dataclass
class _SceneRecordings:
    """The recordings of one scene.

    Attributes:
        mark: Identifies the scene.
        held: Objects outside of the scene that descriptions name by their address.
        recordings: The recordings, by description.
        grids: The data of volumes at the first render. While they are held, no others can get their
            indices.
        refused: Functions that are not frozen.
        cannot_be_recorded: Whether a grid has changed, or Dr.Jit has failed to record a function.
            Others would fail too, when the render has already taken many samples.
    """

    mark: SceneMark
    held: dict[int, Any] = field(default_factory=dict)
    recordings: OrderedDict[Any, _Recording] = field(default_factory=OrderedDict)
    grids: list[Any] | None = None
    refused: set[Any] = field(default_factory=set)
    cannot_be_recorded: bool = False


@dataclass
class _Current:
    """The render that is running.

    Attributes:
        kept: The recordings of its scene.
        scene: Its scene.
        values: Parameters of scene and sensor that are not arrays, and the number of threads.
        own: Addresses of the scene's objects.
        hidden: Arrays of the scene that Dr.Jit does not find in it.
    """

    kept: _SceneRecordings
    scene: mi.Scene
    values: Any
    own: frozenset[int]
    hidden: list[Any]


class _Thread(threading.local):
    """What a thread renders.

    Attributes:
        current: The render that is running.
        is_forbidden: Whether nothing is recorded in it.
    """

    current: _Current | None = None
    is_forbidden = False


class _Process:
    """What the threads share.

    Attributes:
        lock: Held while recordings are used.
        threads: The threads that have rendered.
        scenes: The recordings of each scene.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.threads: weakref.WeakSet[threading.Thread] = weakref.WeakSet()
        self.scenes: OrderedDict[int, _SceneRecordings] = OrderedDict()


_thread, _process = _Thread(), _Process()

T = TypeVar("T")


def with_recordings(scene: mi.Scene, sensor: mi.Sensor, act: Callable[[], T]) -> T:
    """Calls ``act``, which renders ``scene``: frozen functions use what was recorded in earlier
    renders of it. If Dr.Jit cannot record one of them, ``act`` starts over, without recordings."""
    with _process.lock:
        _process.threads.add(threading.current_thread())
    with _nothing_left_waiting():
        try:
            current = _begun(scene, sensor) if _can_freeze() else None
            with _state(current, _thread.is_forbidden):
                return act()
        except NotRecordableError as reason:
            mi.Log(mi.LogLevel.Info, f"the render starts over, without recordings: {reason}")
        with _state(None, True):
            return act()


@contextmanager
def _state(current: _Current | None, is_forbidden: bool) -> Iterator[None]:
    before = _thread.current, _thread.is_forbidden
    _thread.current, _thread.is_forbidden = current, is_forbidden
    try:
        yield
    finally:
        _thread.current, _thread.is_forbidden = before


@contextmanager
def _nothing_left_waiting() -> Iterator[None]:
    """After an exception, evaluates what the interrupted pass has traced. What it scatters would
    otherwise be computed with the next kernels of the thread, when the scene may be gone."""
    try:
        yield
    except BaseException:
        if not dr.flag(dr.JitFlag.FreezingScope):
            with suppress(RuntimeError):
                dr.eval()
        raise


def forget_recordings() -> None:
    """Deletes all recordings."""
    with _process.lock:
        _process.scenes.clear()


def frozen(function: Callable | None = None, *, any_width: bool = False) -> Callable:
    """Decorates a function, or a method, that should be frozen.

    Parameters:
        any_width: Whether its kernels are right for arguments of any width.
    """
    if function is None:
        return functools.partial(frozen, any_width=any_width)

    @functools.wraps(function)
    def call(*args: Any) -> Any:
        if _thread.current is None or dr.flag(dr.JitFlag.FreezingScope):
            return function(*args)
        with _process.lock:
            if _is_alone() and not registry.is_any_called():
                return _call(_thread.current, function, args, any_width)
        return function(*args)

    return call


def _is_alone() -> bool:
    """Whether this is the only thread that may use Dr.Jit. Threads that have rendered may use it,
    and so may threads that the user started (which are not daemons)."""
    others = set(threading.enumerate()) - {threading.current_thread()}
    if not _process.threads.isdisjoint(others):
        return False
    return all(thread.daemon or isinstance(thread, threading.Timer) for thread in others)


def _can_freeze() -> bool:
    wanted = dr.is_jit_v(mi.Float) and not mi.is_spectral and dr.flag(dr.JitFlag.KernelFreezing)
    # A user may freeze a render as a whole
    return wanted and not _thread.is_forbidden and not dr.flag(dr.JitFlag.FreezingScope)


def _begun(scene: mi.Scene, sensor: mi.Sensor) -> _Current | None:
    if sensor.class_name() == "BatchSensor":
        mi.Log(mi.LogLevel.Debug, "nothing is recorded: the sensor is a batch of sensors")
        return None
    parameters = mi.traverse(scene)
    nodes = (*parameters.hierarchy, *mi.traverse(sensor).hierarchy)
    if registry.is_any_called() or any(map(_is_foreign, nodes)):
        mi.Log(mi.LogLevel.Debug, "nothing is recorded: there are plugins in Python")
        return None
    is_on_gpu = dr.backend_v(mi.Float) == dr.JitBackend.CUDA
    if is_on_gpu and any(dr.is_tensor_v(value) for _, value in values_of(parameters)):
        # Dr.Jit 1.5.0 ends the process: "jit_var(r0): unknown variable"
        mi.Log(mi.LogLevel.Debug, "nothing is recorded: there are textures of a GPU")
        return None
    mark = SceneMark(scene)
    if mark.array is None or mark.array.state != dr.VarState.Evaluated:
        return None
    kept = _kept(mark)
    # Copies: the array of a tensor follows changes
    grids = [
        type(value.array)(value.array)
        for node in nodes if isinstance(node, mi.Volume)
        for _, value in values_of(mi.traverse(node)) if dr.is_tensor_v(value)
    ]  # fmt: skip
    kept.grids = grids if kept.grids is None else kept.grids
    if [data.index for data in grids] != [data.index for data in kept.grids]:
        kept.recordings.clear()
        kept.cannot_be_recorded = True
    if kept.cannot_be_recorded:
        return None
    sensors = scene.sensors()
    own = frozenset(address(o) for o in (*sensors, *scene.emitters(), *scene.shapes()))
    # Kernels whose threads accumulate separately have memory for this number of threads
    threads = dr.thread_count()
    hidden = [
        value for node in nodes if isinstance(node, mi.PhaseFunction) or _is_raw(node)
        for _, value in values_of(mi.traverse(node)) if dr.is_jit_v(value)
    ]  # fmt: skip
    name = sensor_name(sensor)
    values = (
        threads, name, constants(parameters), constants(mi.traverse(sensor)),
        tuple(map(literals, hidden)),
    )  # fmt: skip
    if isinstance(name, int) and name not in own:
        kept.held[name] = sensor
    return _Current(kept, scene, values, own, hidden)


def _kept(mark: SceneMark) -> _SceneRecordings:
    """The recordings of a scene; makes room for them."""
    scenes = _process.scenes
    with _process.lock:
        kept = scenes.setdefault(mark.index, _SceneRecordings(mark))
        scenes.move_to_end(mark.index)
        while len(scenes) > _MOST_SCENES:
            scenes.popitem(last=False)
        return kept


def _is_foreign(thing: mi.Object) -> bool:
    """Whether it is written in Python and called by kernels (samplers are arguments)."""
    is_python = type(thing).__module__.partition(".")[0] != "mitsuba"
    return is_python and not isinstance(thing, (mi.Sampler, mi.Integrator))


def _is_raw(node: mi.Object) -> bool:
    return isinstance(node, mi.Texture) and node.class_name() == "RawConstantTexture"


def _call(current: _Current, function: Callable, args: tuple, any_width: bool) -> Any:
    kept = current.kept
    description = CallDescription(current.scene, current.own, any_width)
    try:
        key = (function, current.values, description.of(args))
    except UndescribedError as reason:
        if function not in kept.refused:
            mi.Log(mi.LogLevel.Debug, f"{function.__qualname__} is not frozen: {reason}")
            kept.refused.add(function)
        return function(*args)
    if key in kept.refused:
        return function(*args)
    kept.held.update(description.held)
    recording = kept.recordings.get(key)
    is_new = recording is None
    if is_new:
        recording = kept.recordings[key] = _Recording(function)
        while len(kept.recordings) > _MOST_RECORDINGS:
            kept.recordings.popitem(last=False)
    kept.recordings.move_to_end(key)
    try:
        result = recording(args, [*description.arrays, *current.hidden])
        if is_new:
            _check_result(function, result)
    except NotRecordableError as error:
        # The next render will not try
        kept.recordings.clear()
        kept.cannot_be_recorded = True
        raise NotRecordableError(f"{function.__qualname__} cannot be recorded: {error}") from error
    except BaseException:
        kept.recordings.pop(key, None)
        raise
    if is_new:
        again = CallDescription(current.scene, current.own, any_width)
        if again.of(args) != key[-1] or any(
            a is not b for a, b in zip(again.arrays, description.arrays)
        ):
            what = f"{function.__qualname__} is not frozen: it changes attributes of its arguments"
            mi.Log(mi.LogLevel.Debug, what)
            del kept.recordings[key]
            kept.refused.add(key)
    return result


def _check_result(function: Callable, result: Any) -> None:
    """Checks the types in a result: Dr.Jit would return an object that it does not know as it was
    when it was recorded.

    Raises:
        TypeError: There is such an object in a result.
    """
    kind = type(result)
    if isinstance(result, VALUES) or dr.is_array_v(kind) or hasattr(kind, "DRJIT_STRUCT"):
        return
    if isinstance(result, dict):
        parts = list(result.values())
    elif isinstance(result, (list, tuple)):
        parts = list(result)
    elif is_dataclass(kind):
        parts = list(vars(result).values())
    else:
        raise TypeError(f"{function.__qualname__} is frozen, and returns a {kind.__qualname__}")
    for part in parts:
        _check_result(function, part)


class _Recording:
    """The kernels that Dr.Jit has recorded of a function, for arguments of one description."""

    def __init__(self, function: Callable) -> None:
        self._function, self._args = function, ()
        self._frozen = dr.freeze(self._run, warn_after=1 << 20)

    def _run(self, arrays: list[Any]) -> Any:
        # The arrays are those that the arguments hold: Dr.Jit must see them as inputs
        return self._function(*self._args)

    def __call__(self, args: tuple, arrays: list[Any]) -> Any:
        self._args = args
        try:
            # The garbage collector may free memory of NumPy, which makes Dr.Jit end the process
            with garbage_left_alone():
                return self._frozen(arrays)
        except RuntimeError as error:
            cause = error.__cause__
            if cause is None or any(words in str(cause) for words in _OF_RECORDING):
                raise NotRecordableError(str(cause or error)) from error
            raise cause from None
        finally:
            self._args = ()
