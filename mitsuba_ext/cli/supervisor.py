"""A comparison runs in a process of its own, which an integrator may take down with it.

Out of memory, a fault in native code, an abort of LLVM: none of these can be caught in Python. The
supervisor notes during which run the process died, and starts another; that one finds the finished
runs in the folder, gives the guilty integrator a failed row, and goes on with the others.

Mitsuba's own integrators cannot be interrupted: after Ctrl-C, the process ends when the running
render does. A second Ctrl-C kills it, and another process writes the report of what is finished.
"""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import click

from .common import INTERRUPTED

#: What the context's ``obj`` is in a process that was started from a shell.
SUPERVISED = "supervised"

#: Jobs of a worker: measure, or report what is there.
MEASURE, STORED = JOBS = ("measure", "stored")


def supervise(arguments: Sequence[str], folder: Path) -> int:
    """Runs ``mitsuba-ext`` with ``arguments`` in worker processes; returns the exit code."""
    from ..compare import runs

    runs.forgive(folder)
    while True:
        code = _work(arguments, MEASURE)
        if code is None:
            click.echo("interrupted: the running render is given up", err=True)
            return _work(arguments, STORED) or INTERRUPTED
        if code >= 0:
            return code
        message = f"the process died of {_signal_name(-code)} in this render"
        if not runs.blame(folder, message):
            click.echo(f"mitsuba-ext: the process died of {_signal_name(-code)}", err=True)
            return 1
        click.echo(f"mitsuba-ext: {message}; going on with the others", err=True)


def without_job(arguments: Sequence[str]) -> list[str]:
    """The arguments as the user gave them."""
    return [text for text in arguments if not text.startswith("--worker=")]


def _work(arguments: Sequence[str], job: str) -> int | None:
    """Runs a worker; ``None`` if a second Ctrl-C killed it."""
    command = [sys.executable, "-m", "mitsuba_ext.cli", *arguments, f"--worker={job}"]
    worker = subprocess.Popen(command)
    interrupts = 0
    while True:
        try:
            return worker.wait()
        except KeyboardInterrupt:  # the terminal sends it to the worker too
            interrupts += 1
            if interrupts == 1:
                click.echo("\nwaiting for the running render (Ctrl-C: give it up)", err=True)
            else:
                worker.kill()
                worker.wait()
                return None


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
