"""A comparison runs in a process of its own, which an integrator may take down with it.

Out of memory, a fault in native code, an abort of LLVM: none of these can be caught in Python. The
supervisor notes at which run the process died, and starts another; that one finds the finished runs
in the folder, gives the guilty integrator a failed row, and goes on with the others.

Mitsuba's own integrators cannot be interrupted: after Ctrl-C, the process ends when the running
render does. A second Ctrl-C kills it, and another process writes the report of what is finished.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import click

from ..processes import python_command
from .common import INTERRUPTED

#: What the context's ``obj`` is in a process that was started from a shell.
SUPERVISED = "supervised"

#: Jobs of a worker: measure, or report what is there.
MEASURE, STORED = JOBS = ("measure", "stored")

_PR_SET_PDEATHSIG = 1


def supervise(arguments: Sequence[str], folder: Path) -> int:
    """Runs ``mitsuba-ext`` with ``arguments`` in worker processes; returns the exit code."""
    from ..compare import runs

    runs.forgive(folder)
    while True:
        code = _work(arguments, MEASURE)
        if code is None:
            click.echo("interrupted: the running render is given up", err=True)
            runs.forgive(folder)
            return _work(arguments, STORED) or INTERRUPTED
        reason = f"died of {_signal_name(-code)}" if code < 0 else f"ended with exit code {code}"
        if runs.blame(folder, f"the process {reason} in this render"):
            click.echo(f"mitsuba-ext: the process {reason}; going on with the others", err=True)
        elif code < 0:
            click.echo(f"mitsuba-ext: the process {reason}", err=True)
            return 1
        else:
            return code


def without_job(arguments: Sequence[str]) -> list[str]:
    """The arguments as the user gave them."""
    return [text for text in arguments if not text.startswith("--worker=")]


def follow_parent() -> None:
    """Makes this worker end when its supervisor is killed (on Linux)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _work(arguments: Sequence[str], job: str) -> int | None:
    """Runs a worker; ``None`` if a second Ctrl-C killed it."""
    from ..compare import runs

    command = python_command("mitsuba_ext", *arguments, f"--worker={job}")
    # In a session of its own, it gets signals from here alone: each of them once
    worker = subprocess.Popen(
        command, start_new_session=True, env={**os.environ, runs.SESSION_VARIABLE: runs.SESSION}
    )
    interrupts = 0
    with _passing_on(worker):
        while True:
            try:
                return worker.wait()
            except KeyboardInterrupt:
                interrupts += 1
                if interrupts == 1:
                    worker.send_signal(signal.SIGINT)
                    click.echo("\nwaiting for the running render (Ctrl-C: give it up)", err=True)
                else:
                    worker.kill()
                    worker.wait()
                    return None


@contextlib.contextmanager
def _passing_on(worker: subprocess.Popen) -> Iterator[None]:
    """What ends the supervisor ends the worker."""

    def end(number: int, _frame: object) -> None:
        worker.kill()
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)

    numbers = [signal.SIGTERM] + ([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])
    previous = {number: signal.signal(number, end) for number in numbers}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
