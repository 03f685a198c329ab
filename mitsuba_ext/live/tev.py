"""Sends snapshots to tev, the image viewer of T. Müller (https://github.com/Tom94/tev), through its
own module ``tevclient``."""

from __future__ import annotations

import re
import socket
import sys
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np

from ..util.errors import InputError, one_line
from .snapshot import Snapshot

#: Where tev listens by default.
DEFAULT = "127.0.0.1:14158"

#: The time in which tev must accept a connection, in seconds.
_CONNECT_SECONDS = 3.0


class TevReceiver:
    """Keeps an image in tev up to date: all channels, and the variance as ``variance.R`` and so on.

    If tev is not there, or is closed, the render continues, and each snapshot tries to connect
    again.

    Parameters:
        address: ``HOST:PORT``, ``HOST`` or ``:PORT``.
        warn: Called with a sentence if tev does not answer.

    Raises:
        InputError: The address has another form, or ``tevclient`` is not installed.
    """

    def __init__(self, address: str, warn: Callable[[str], None]) -> None:
        self._host, self._port = _host_and_port(address)
        self._warn, self._has_warned = warn, False
        self._client = _client()
        self._connection = ExitStack()
        self._ipc: Any = None
        # What tev holds: the size and the channels, by image
        self._known: dict[str, tuple[Any, ...]] = {}

    def receive(self, name: str, snapshot: Snapshot) -> None:
        try:
            self._send(name, snapshot)
        except Exception as error:  # tev is not there, or was closed
            self._connection.close()
            self._ipc = None
            self._known.clear()
            if not self._has_warned:
                self._has_warned = True
                where = f"{self._host}:{self._port}"
                what = error.strerror if isinstance(error, OSError) and error.strerror else ""
                self._warn(
                    f"tev does not answer at {where} ({what or one_line(error)}): the render "
                    f"continues, and is shown as soon as tev runs"
                )

    def begin(self) -> None:
        pass

    def describe(self, facts: dict[str, str]) -> None:
        pass

    def tell(self, figures: dict[str, Any]) -> None:
        pass

    def close(self, phase: str) -> None:
        pass  # tev keeps the image; the connection ends with the process

    def _send(self, name: str, snapshot: Snapshot) -> None:
        if self._ipc is None:
            # tevclient itself would wait for minutes
            socket.create_connection((self._host, self._port), _CONNECT_SECONDS).close()
            self._ipc = self._connection.enter_context(self._client(self._host, self._port))
            self._has_warned = False
        planes = {_channel(key): plane for key, plane in snapshot.planes().items()}
        names, (height, width) = list(planes), snapshot.image.shape[:2]
        if self._known.get(name) != (width, height, names):
            # The first time, tev shows it; then the user may look at another image
            is_new = name not in self._known
            self._ipc.create_image(name, width, height, names, grab_focus=is_new)
            self._known[name] = width, height, names
        pixels = np.stack(list(planes.values()), axis=2).astype(np.float32, copy=False)
        self._ipc.update_image(name, pixels, names)


def _client() -> type:
    try:
        from tevclient import Ipc
    except ImportError:
        how = "pip install 'mitsuba_ext[view]'"
        if sys.version_info < (3, 11):  # noqa: UP036
            how = "use Python 3.11 or later, which tevclient needs"
        raise InputError(f'--tev: the package "tevclient" is missing: {how}') from None
    return Ipc


def _host_and_port(address: str) -> tuple[str, int]:
    default_host, default_port = DEFAULT.split(":")
    match = re.fullmatch(r"([^:\s]*)(?::(\d{1,5}))?", address)
    port = int(match[2] or default_port) if match else 0
    if not match or not 1 <= port <= 65535:
        raise InputError(f'--tev: expected HOST:PORT such as {DEFAULT}, found "{address}"')
    return match[1] or default_host, port


def _channel(name: str) -> str:
    """A name of a channel that tev can read: ASCII, and no digit at the beginning, since tev writes
    the length of the name before it."""
    name = name.encode("ascii", "replace").decode()
    return f"_{name}" if name[:1].isdigit() else name
