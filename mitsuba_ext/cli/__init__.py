"""The command ``mitsuba-ext``, one file per subcommand.

Mitsuba's own command cannot load plugins written in Python. Exit codes: 0 (success), 1 (an image
with NaN or infinite pixels, a comparison in which an integrator failed or a reference was too
noisy, or a problem that the doctor found), 2 (bad input: one line on stderr), 130, 143 and 129
(Ctrl-C, SIGTERM and SIGHUP).
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence

import click

from ..startup.processes import restart_in_utf8
from ..util.errors import InputError, InstallationError
from ..util.files import is_utf8, printable
from ..util.version import __version__
from .common import INTERRUPTED, say
from .compare import compare
from .completion import completion, register
from .denoise import denoise
from .diff import diff
from .export_blender import export_blender
from .merge import merge
from .plugins import list_plugins
from .relight import relight
from .render import render
from .replay import replay
from .supervisor import SUPERVISED
from .view import view


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="mitsuba-ext")
def cli() -> None:
    """Light transport techniques for Mitsuba 3.

    Exit codes: 0; 1 (an image with NaN or infinite pixels, a comparison in which something failed,
    a problem that the doctor found); 2 (bad input, in one line on stderr); 130, 143 and 129
    (Ctrl-C, SIGTERM and SIGHUP, with the image so far).
    """


@click.command(short_help="Check the installation.")
def doctor() -> int:
    """Check Mitsuba's version, the LLVM library, and a small render."""
    from ..startup import doctor as doctor_module

    return doctor_module.main()


for command in (
    render, view, merge, denoise, relight, compare, diff, replay, list_plugins, doctor,
    export_blender, completion,
):  # fmt: skip
    cli.add_command(command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command and returns its exit code."""
    if arguments is None:
        restart_in_utf8()
    for text in map(str, sys.argv[1:] if arguments is None else arguments):
        if not is_utf8(text):
            _complain(f'"{printable(text)}" is not UTF-8, which Mitsuba needs: rename the file')
            return 2
    register()
    try:
        # Comparisons run in worker processes only if started from a shell, not from Python
        obj = SUPERVISED if arguments is None else None
        code = cli.main(arguments, prog_name="mitsuba-ext", standalone_mode=False, obj=obj)
    except click.Abort as error:
        say("interrupted")
        number = getattr(error.__cause__, "number", None)
        return INTERRUPTED if number is None else 128 + number
    except click.ClickException as error:
        if not list(sys.argv[1:] if arguments is None else arguments):
            error.show()  # the help, because no subcommand was given
        else:
            _complain(_explained(error))
        return 2
    except (InputError, InstallationError) as error:
        _complain(str(error))
        return 2
    except BrokenPipeError:
        return 1
    except OSError as error:  # a full disk, a deleted folder
        is_named = error.filename is not None and error.strerror
        _complain(f"{error.filename}: {error.strerror}" if is_named else str(error))
        return 2
    return code if isinstance(code, int) else 0


def _explained(error: click.ClickException) -> str:
    """Click's message, extended by hints for new users."""
    text = error.format_message()
    for kind, meant in (("integer", "whole number"), ("float", "number")):
        text = text.replace(f"valid {kind} range", meant)
    unknown = re.fullmatch(r"No such command '(.*)'\.", text)
    if unknown and unknown[1].lower().endswith(".xml"):
        return f"{text[:-1]}: 'mitsuba-ext render {unknown[1]} -o image.exr' renders this scene"
    if unknown:
        return f"{text[:-1]} ('mitsuba-ext --help' lists the commands)"
    if isinstance(error, click.MissingParameter) and isinstance(error.param, click.Option):
        what = re.split(r"[:.] ", error.param.help or "")[0]
        return f"{text.rstrip('.')}: {what[:1].lower()}{what[1:]}"
    return text


def _complain(message: str) -> None:
    say(f"mitsuba-ext: {' '.join(message.split())}")
