"""``python -m mitsuba_ext``: the command ``mitsuba-ext``."""

import signal
import sys


def main() -> int:
    """Runs the command and returns its exit code. Until it handles signals, Ctrl-C ends the process
    without a traceback, and the request to save a render, which has not begun, is ignored."""
    is_default = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if is_default:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    if hasattr(signal, "SIGUSR1"):
        signal.signal(signal.SIGUSR1, signal.SIG_IGN)
    from .cli import main as command

    if is_default:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return command()


if __name__ == "__main__":
    sys.exit(main())
