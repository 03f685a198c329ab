"""A comparison runs in a process of its own, which an integrator may take down with it.

Out of memory, a fault in native code, an abort of LLVM: none of these can be caught in Python. The
supervisor notes at which integrator the process died, and starts another; that one finds the
finished runs in the folder, gives the guilty integrator a failed row, and goes on with the others.

Mitsuba's own integrators cannot be interrupted: after Ctrl-C, the process ends when the running
render does. A second Ctrl-C kills it, and another process writes the report of what is finished.
SIGTERM and SIGHUP, which batch systems send before they kill, end it alike, but the running render
has no more than :data:`GRACE` seconds. Signals that come together count as one.
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

from .. import marks
from ..processes import python_command
from ..rendering import interrupts
from .common import INTERRUPTED, say

#: What the context's ``obj`` is in a process that was started from a shell.
SUPERVISED = "supervised"

#: Jobs of a worker: measure, or report what is there.
MEASURE, STORED = JOBS = ("measure", "stored")

#: Seconds that a running render has after SIGTERM or SIGHUP. Batch systems kill after 10 to 30, and
#: the report takes a few.
GRACE = 3.0

#: Exit codes of a worker that came to its end: finished, with trouble, bad input, interrupted.
_IN_ORDER = (0, 1, 2, INTERRUPTED)

#: Seconds after which is looked for signals that have come.
_POLL = 0.1

_PR_SET_PDEATHSIG = 1


def supervise(arguments: Sequence[str], folder: Path) -> int:
    """Runs ``mitsuba-ext`` with ``arguments`` in worker processes; returns the exit code.

    Raises:
        InputError: Another comparison is running in ``folder``.
    """
    with _collected_signals() as received, marks.in_use(folder):
        blamed: set[Path] = set()
        while True:
            end = _work(arguments, folder, MEASURE, received)
            if end.signal and end.code in _IN_ORDER:
                return 128 + end.signal if end.code == INTERRUPTED else end.code
            if end.signal:
                say("interrupted: the running render is given up")
                marks.forgive(folder)
                _work(arguments, folder, STORED, received)
                return 128 + end.signal
            reason = _reason(end.code)
            guilty = marks.blame(folder, end.process, f"the process {reason} in this render")
            if not guilty:
                if end.code not in _IN_ORDER:
                    say(f"mitsuba-ext: the process {reason}")
                return end.code if end.code >= 0 else 1
            if guilty <= blamed:
                say(f"mitsuba-ext: the process {reason} in the same render again: given up")
                return 1
            blamed |= guilty
            say(f"mitsuba-ext: the process {reason}; going on with the others")


def without_job(arguments: Sequence[str]) -> list[str]:
    """The arguments as the user gave them."""
    return [text for text in arguments if not text.startswith("--worker=")]


def become_worker() -> None:
    """Makes this process end when its supervisor is killed (on Linux), and interrupts it once,
    whatever signal says so: the report that it then writes is not interrupted again."""
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
    """How a worker ended.

    Attributes:
        process: Its number.
        code: Its exit code; negative if a signal ended it.
        signal: The signal that asked it to end; 0 if none did.
    """

    process: int
    code: int
    signal: int


def _command(arguments: Sequence[str], job: str) -> list[str]:
    return python_command("mitsuba_ext", *arguments, f"--worker={job}")


def _work(arguments: Sequence[str], folder: Path, job: str, received: list[int]) -> _End:
    """Runs a worker to its end; the first signal asks it to end, another one kills it."""
    # In a session of its own, it gets signals from here alone: each of them once
    worker = subprocess.Popen(
        _command(arguments, job),
        start_new_session=True,
        env={**os.environ, marks.SESSION_VARIABLE: marks.SESSION},
    )
    asked, deadline = 0, math.inf
    while True:
        try:
            return _End(worker.pid, worker.wait(_POLL), asked)
        except subprocess.TimeoutExpired:
            pass
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
            if marks.running(folder, worker.pid):  # else it is writing the report
                worker.kill()


@contextlib.contextmanager
def _collected_signals() -> Iterator[list[int]]:
    """The numbers of the signals that ask this process to end, as they come; of those that come
    together, the first. (Exceptions in their place could come at any time, also while the last one
    is being dealt with.)"""
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
        # Workers would inherit that, and must hear the SIGINT that is sent from here
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
