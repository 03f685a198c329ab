"""A web page, on this machine only, that shows a render while it runs.

Web sites that the user visits must not reach it. Requests need a ``Host`` of this machine, because
a site may rebind its own name to 127.0.0.1. What changes the render also needs a key, which only
the address printed on the terminal has, in a header that other sites cannot send.
"""

from __future__ import annotations

import errno
import hmac
import json
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Protocol
from urllib.parse import parse_qs, urlsplit

from ..util.errors import InputError
from .page import policy, render_page
from .snapshot import Snapshot
from .web_state import WebState

#: The only address at which it can be reached.
HOST = "127.0.0.1"

#: The names of this machine in the header ``Host``. (A tunnel may have another port.)
_NAMES = (HOST, "localhost", "[::1]")

#: The header with the key.
_KEY = "X-Mitsuba-Ext-Key"

#: The time in which a browser must send a request or take an answer, in seconds.
_SLOW = 10.0

#: The time for which open pages may take to load the last image, in seconds.
_LAST_SECONDS = 5.0


class Rendering(Protocol):
    """What the page can ask and do (:class:`~mitsuba_ext.live.viewer.Viewer`)."""

    phase: str

    def pause(self) -> None: ...

    def resume(self) -> None: ...

    def stop(self) -> None: ...

    def spent(self, seconds: float) -> None: ...


class WebReceiver:
    """Serves the page.

    Parameters:
        port: The port; 0 for any that is free.

    Attributes:
        state: What the page shows.
        actions: What a page with the key can do, by name; empty if pages can only look.
        key: The key.

    Raises:
        InputError: The port cannot be used.
    """

    def __init__(self, port: int) -> None:
        self.state = WebState()
        self.actions: dict[str, Callable[[], None]] = {}
        self.key = secrets.token_urlsafe(16)
        handler = type("Handler", (_Handler,), {"web": self})
        try:
            self._server = _Server((HOST, port), handler)
        except OSError as error:
            is_taken = error.errno == errno.EADDRINUSE
            why = "is in use" if is_taken else f"cannot be used ({error.strerror})"
            raise InputError(
                f"--serve: port {port} {why}: name another one, or 0 for any that is free"
            ) from None

    def serve(self, render: Rendering, has_control: bool) -> None:
        """Begins to serve.

        Args:
            render: Knows what the render does, and can pause and stop it.
            has_control: Whether pages with the key may do so, too.
        """
        self.render, self.state.spent = render, render.spent
        if has_control:
            self.actions.update(pause=render.pause, resume=render.resume, stop=render.stop)
        threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True
        ).start()

    @property
    def address(self) -> str:
        """The address of the page, with the key if it can do something."""
        # What follows # is not sent to servers, and does not appear in their logs
        key = f"#{self.key}" if self.actions else ""
        return f"http://{HOST}:{self._server.server_address[1]}/{key}"

    def receive(self, name: str, snapshot: Snapshot) -> None:
        self.state.receive(name, snapshot)

    def begin(self) -> None:
        self.state.begin()

    def describe(self, facts: dict[str, str]) -> None:
        self.state.describe(facts)

    def tell(self, figures: dict[str, Any]) -> None:
        self.state.tell(figures)

    def close(self, phase: str) -> None:
        """Waits until open pages show the last image, and ends."""
        end = time.monotonic() + _LAST_SECONDS
        while not self.state.all_have_seen(phase) and time.monotonic() < end:
            time.sleep(0.05)
        self._server.shutdown()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def handle_error(self, request: Any, client_address: Any) -> None:
        pass  # a browser that was closed


class _Handler(BaseHTTPRequestHandler):
    web: WebReceiver
    server_version, sys_version = "mitsuba_ext", ""
    timeout = _SLOW

    def do_GET(self) -> None:
        if not self._is_local():
            return
        url = urlsplit(self.path)
        query = {key: values[0] for key, values in parse_qs(url.query).items()}
        if url.path == "/":
            self._answer(render_page().encode(), "text/html; charset=utf-8")
        elif url.path == "/state":
            self._state(query)
        elif url.path in ("/image", "/error"):
            found = self.web.state.content(query.get("name", ""), url.path[1:])
            if found is None:
                self._refuse(HTTPStatus.NOT_FOUND)
            else:
                self._answer(found[1], "application/octet-stream", {"X-Number": str(found[0])})
        else:
            self._refuse(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        if not self._is_local():
            return
        origin = self.headers.get("Origin")
        action = self.web.actions.get(self.path[1:])
        if action is None:
            self._refuse(HTTPStatus.NOT_FOUND)
        elif origin is not None and origin != f"http://{self.headers.get('Host')}":
            self._refuse(HTTPStatus.FORBIDDEN)
        elif not hmac.compare_digest(self.headers.get(_KEY, "").encode(), self.web.key.encode()):
            self._refuse(HTTPStatus.FORBIDDEN)
        else:
            action()
            self._answer(b"{}", "application/json")

    def log_message(self, *_arguments: Any) -> None:
        pass

    def _state(self, query: Mapping[str, str]) -> None:
        web = self.web
        if page := query.get("page"):
            number = query.get("number", "0")
            number = int(number) if number.isdecimal() and len(number) < 16 else 0
            web.state.seen(page[:32], number, query.get("phase", ""))
        known = {**web.state.as_dict(web.render.phase), "actions": sorted(web.actions)}
        self._answer(json.dumps(known).encode(), "application/json")

    def _is_local(self) -> bool:
        """Whether the request names this machine; otherwise, it is refused."""
        host = self.headers.get("Host", "")
        name, _, port = host.rpartition(":") if ":" in host.split("]")[-1] else (host, "", "")
        if name.lower() in _NAMES and (not port or port.isdecimal()):
            return True
        self._refuse(HTTPStatus.FORBIDDEN)
        return False

    def _refuse(self, status: HTTPStatus) -> None:
        self._answer(status.phrase.encode(), "text/plain", status=status)

    def _answer(
        self, content: bytes, kind: str, headers: Mapping[str, str] | None = None,
        status: HTTPStatus = HTTPStatus.OK,
    ) -> None:  # fmt: skip
        self.send_response(status)
        for name, value in {
            "Content-Type": kind, "Content-Length": str(len(content)), "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff", "Cross-Origin-Resource-Policy": "same-origin",
            "Content-Security-Policy": policy(), "Referrer-Policy": "no-referrer",
            **(headers or {}),
        }.items():  # fmt: skip
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)
