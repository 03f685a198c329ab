"""A stand-in for the viewer tev: it understands the packets that tev's ``Ipc.cpp`` reads."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading

import numpy as np

CREATE, UPDATE = 4, 6


class FakeTev:
    """Listens on a port (0 for any that is free), and keeps the images that it is sent.

    Attributes:
        address: ``HOST:PORT``.
        images: By name, the channels by name.
        focused: The names of the images that asked for the focus.
        updates: The number of images that have arrived as a whole.
    """

    def __init__(self, port: int = 0, reads: bool = True) -> None:
        self._socket = socket.create_server(("127.0.0.1", port))
        self.port = self._socket.getsockname()[1]
        self.address = f"127.0.0.1:{self.port}"
        self.images: dict[str, dict[str, np.ndarray]] = {}
        self.focused: list[str] = []
        self.updates = 0
        self.changed = threading.Condition()
        self.connections: list[socket.socket] = []
        self._reads = reads
        threading.Thread(target=self._accept, daemon=True).start()

    def wait_for(self, updates: int) -> None:
        """Waits until that many images have arrived."""
        with self.changed:
            assert self.changed.wait_for(lambda: self.updates >= updates, 60)

    def close(self) -> None:
        """Ends as tev does when its window is closed."""
        for each in (self._socket, *self.connections):
            with contextlib.suppress(OSError):  # the other side was faster
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:
                return
            self.connections.append(connection)
            if self._reads:
                threading.Thread(target=self._serve, args=[connection], daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        stream = connection.makefile("rb")
        try:
            while head := stream.read(4):
                (length,) = struct.unpack("<I", head)
                self._take(_Packet(stream.read(length - 4)))
        except (OSError, ValueError):
            pass  # closed meanwhile

    def _take(self, packet: _Packet) -> None:
        kind, has_focus, name = packet.number("b"), packet.number("b"), packet.text()
        if kind == CREATE:
            width, height, count = (packet.number("i") for _ in range(3))
            channels = [packet.text() for _ in range(count)]
            # As tev: the names follow their lengths in a text, so a digit would belong to these
            assert not any(channel[:1].isdigit() for channel in channels)
            self.images[name] = {channel: np.zeros((height, width)) for channel in channels}
            self.focused += [name] * has_focus
            return
        assert kind == UPDATE
        channels = [packet.text() for _ in range(packet.number("i"))]
        x, y, width, height = (packet.number("i") for _ in range(4))
        offsets, strides = ([packet.number("q") for _ in channels] for _ in range(2))
        values, place = packet.floats(), np.arange(width * height)
        planes = self.images[name]
        for channel, offset, stride in zip(channels, offsets, strides):
            tile = values[offset + stride * place].reshape(height, width)
            planes[channel][y : y + height, x : x + width] = tile
        full = next(iter(planes.values())).shape
        with self.changed:
            self.updates += (y + height, x + width) == full
            self.changed.notify_all()


class _Packet:
    def __init__(self, content: bytes) -> None:
        self._content, self._place = content, 0

    def number(self, kind: str) -> int:
        (value,) = struct.unpack_from(f"<{kind}", self._content, self._place)
        self._place += struct.calcsize(kind)
        return value

    def text(self) -> str:
        end = self._content.index(0, self._place)
        text = self._content[self._place : end].decode()
        self._place = end + 1
        return text

    def floats(self) -> np.ndarray:
        return np.frombuffer(self._content[self._place :], "<f4")
