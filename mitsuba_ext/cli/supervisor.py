"""Runs a comparison in a worker process, because an integrator can crash.

Python cannot catch a lack of memory, a fault in native code, or an abort of LLVM. The supervisor
records which integrator was rendering when the worker died, and starts another worker. The new
worker finds the finished runs in the folder, reports that integrator as failed, and runs the rest.

An integrator can also hang: with a limit, the supervisor kills a worker whose render takes longer.

Mitsuba's own integrators cannot be interrupted: after Ctrl-C, the worker ends when the running
render does. A second Ctrl-C kills it, and another worker writes the report of the finished runs.
SIGTERM and SIGHUP, which batch systems send before they kill, act like Ctrl-C, but the running
render has at most :data:`GRACE` seconds. Signals within half a second count as one.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from ..rendering import interrupts
from ..startup.processes import python_command
from ..util import marks
from .common import INTERRUPTED, say

#: The value of the click context's ``obj`` in a process started from a shell.
SUPERVISED = "supervised"

#: The jobs of a worker: measure, or write the report of the stored runs.
MEASURE, STORED = JOBS = ("measure", "stored")

#: The time in which a running render may finish after SIGTERM or SIGHUP, in seconds. Batch systems
#: kill after 10 to 30 seconds, and the report takes a few.
GRACE = 3.0

#: Exit codes of a worker that did not crash: success, failed integrators, bad input, interrupted.
_IN_ORDER = (0, 1, 2, INTERRUPTED)

#: The time between two checks for received signals, in seconds.
_POLL = 0.1

_PR_SET_PDEATHSIG = 1


def supervise(arguments: Sequence[str], folder: Path, limit: float = math.inf) -> int:
    """Runs ``mitsuba-ext`` with ``arguments`` in worker processes; returns the exit code.

    Args:
        limit: The time limit of a render, in seconds. A worker that takes longer is killed, and its
            integrator is reported as failed.

    Raises:
        InputError: Another comparison is running in ``folder``.
    """
    with _collected_signals() as received, marks.in_use(folder):
        blamed: set[Path] = set()
        while True:
            end = _work(arguments, folder, MEASURE, received, limit)
            if end.signal and end.code in _IN_ORDER:
                return 128 + end.signal if end.code == INTERRUPTED else end.code
            if end.signal:
                say("interrupted: the running render is given up")
                marks.forgive(folder)
                _work(arguments, folder, STORED, received)
                return 128 + end.signal
            reason = _reason(end.code)
            message = f"the process {reason} in this render"
            if end.is_late:
                reason = f"took more than the {limit:g} s of --limit for a render, and was stopped"
                message = f"a render took more than the {limit:g} s of --limit"
            guilty = marks.blame(folder, end.process, message)
            if not guilty:
                if end.code not in _IN_ORDER:
                    say(f"mitsuba-ext: the process {reason}")
                return end.code if end.code >= 0 else 1
            if guilty <= blamed:
                say(f"mitsuba-ext: the process {reason} in the same render again: given up")
                return 1
            blamed |= guilty
            say(f"mitsuba-ext: the process {reason}; continuing with the others")


def without_job(arguments: Sequence[str]) -> list[str]:
    """The arguments that the user gave, without the option ``--worker``."""
    return [text for text in arguments if not text.startswith("--worker=")]


def become_worker() -> None:
    """Makes this process end when its supervisor is killed (on Linux). The first signal of any kind
    raises ``KeyboardInterrupt``; later ones are ignored, because the report is being written."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    signals = [n for n in interrupts.SIGNALS if signal.getsignal(n) is not signal.SIG_IGN]

    def interrupt(_number: int, _frame: object) -> None:
        for number in signals:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    for number in signals:
        signal.signal(number, interrupt)


class _End(NamedTuple):
    """The end of a worker.

    Attributes:
        process: The worker's process id.
        code: The exit code; negative if a signal ended the worker.
        signal: The signal that requested its end; 0 if none did.
        is_late: Whether it was killed because a render took too long.
    """

    process: int
    code: int
    signal: int
    is_late: bool = False


def _command(arguments: Sequence[str], job: str) -> list[str]:
    return python_command("mitsuba_ext", *arguments, f"--worker={job}")


def _work(
    arguments: Sequence[str], folder: Path, job: str, received: list[int], limit: float = math.inf
) -> _End:
    """Runs a worker to its end. The first signal interrupts it, a second one kills it, and so does
    a render that takes longer than ``limit`` seconds."""
    # In a separate session, the worker receives only the signals sent below, not the terminal's
    worker = subprocess.Popen(
        _command(arguments, job),
        start_new_session=True,
        env={**os.environ, marks.SESSION_VARIABLE: marks.SESSION},
    )
    asked, deadline = 0, math.inf
    seen: dict[tuple[Path, int], float] = {}
    is_late = False
    while True:
        try:
            return _End(worker.pid, worker.wait(_POLL), asked, is_late)
        except subprocess.TimeoutExpired:
            pass
        if limit < math.inf and not is_late:
            now = time.monotonic()
            seen = {render: seen.get(render, now) for render in marks.begun(folder, worker.pid)}
            if any(now - begin > limit for begin in seen.values()):
                is_late = True
                worker.kill()
        while received:
            number = received.pop(0)
            if asked:
                worker.kill()
                continue
            asked = number
            worker.send_signal(signal.SIGINT)
            if number == signal.SIGINT:
                say("\nwaiting for the running render (Ctrl-C: give it up)")
            else:
                deadline = time.monotonic() + GRACE
        if time.monotonic() > deadline:
            deadline = math.inf
            if marks.running(folder, worker.pid):  # otherwise it is writing the report
                worker.kill()


@contextlib.contextmanager
def _collected_signals() -> Iterator[list[int]]:
    """Collects the numbers of received signals in a list; of several signals within half a second,
    only the first. (An exception raised by a signal could occur at any time, even while another
    exception is being handled.)"""
    received: list[int] = []
    first = -math.inf

    def collect(number: int, _frame: object) -> None:
        nonlocal first
        now = time.monotonic()
        if now - first > interrupts.TOGETHER:
            first = now
            received.append(number)

    is_deaf = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    if is_deaf:
        # Workers would inherit an ignored SIGINT, with which _work() interrupts them
        signal.signal(signal.SIGINT, lambda *_: None)
    numbers = [n for n in interrupts.SIGNALS if not (is_deaf and n == signal.SIGINT)]
    try:
        with interrupts.handling(numbers, collect):
            yield received
    finally:
        if is_deaf:
            signal.signal(signal.SIGINT, signal.SIG_IGN)


def _reason(code: int) -> str:
    if code >= 0:
        return f"ended with exit code {code}"
    try:
        return f"died of {signal.Signals(-code).name}"
    except ValueError:
        return f"died of signal {-code}"
