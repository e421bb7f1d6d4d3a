"""`LiveView`: a page on this machine that shows an episode while it runs, with the player of reports."""

import json
import os
import re
import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any, Self

from slam_backend.core.validation import argument_error
from training.episodes.runner import Progress
from training.report.content import Content
from training.report.page import render

HOST = "127.0.0.1"
OWN = re.compile(r"(127\.0\.0\.1|localhost\.?|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE)  # names of this machine
VERSION = re.compile(r"after=([0-9]{1,9})")
ANSWER_S = 5.0  # longest wait of a request for new content [s]
WATCHED_S = 2.0 * ANSWER_S  # content is made as long as the last request is not older [s]
SHARE = 0.1  # share of the time that making content may take
SHORTEST_S = 0.25  # between two contents [s]
NAP_S = 0.1  # longest sleep between two looks at `should_stop` [s]


class LiveView:
    """Server of a page that shows an episode while it runs; it answers requests of this machine only.

    Content is made by the thread of the episode, between two steps, and only while a page is open. A context manager:
    the server ends with the block.

    Args:
        port: Port of 127.0.0.1; 0: any free one.
        speed: Simulated seconds per second; 0: as fast as the episode runs.

    Raises:
        ValueError: If the port is not free.
    """

    def __init__(self, port: int, speed: float) -> None:
        self._speed = speed
        self._content: Callable[[], Content] = lambda: Content(title="")
        self._should_stop: Callable[[], bool] = lambda: False
        self._changed = threading.Condition()
        self._version, self._shown, self._news = 0, Content(title="vslam run"), b""
        self._page: tuple[Content, bytes] | None = None
        self._is_over = False
        self._asked = -WATCHED_S  # time of the last request for content
        self._sent = 0  # newest version that a page has
        self._next = 0.0
        self._begin: float | None = None
        try:
            self._server = _Server((HOST, port), _handler_of(self))
        except (OSError, OverflowError) as error:
            hint = "Choose another one with --port; --port 0 takes any free one."
            raise argument_error("port", f"a free port of {HOST}", port, hint) from error

    @property
    def address(self) -> str:
        """Address of the page."""
        return f"http://{HOST}:{self._server.server_address[1]}/"

    def __enter__(self) -> Self:
        """Return the view; it answers requests from the first step on."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Tell the pages that the episode is over, and end the server."""
        with self._changed:
            self._is_over = True
            self._changed.notify_all()
        if self._begin is not None:
            self._server.shutdown()
        self._server.server_close()

    def shows(self, content: Callable[[], Content], should_stop: Callable[[], bool]) -> None:
        """Set what is shown.

        Args:
            content: Function that returns the content of the page at the time of the call.
            should_stop: Function that ends all waiting when it returns true.
        """
        self._content, self._should_stop = content, should_stop

    def on_step(self, progress: Progress) -> None:
        """Show a step and keep the speed; at the first call wait until a page is open."""
        now = time.monotonic()
        if self._begin is None:
            self._publish()
            self._begin = now
            threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": NAP_S}, daemon=True).start()
            while not self._asked_lately() and not self._should_stop():
                time.sleep(NAP_S)
            self._begin = now = time.monotonic()
        if now >= self._next and self._asked_lately():
            self._publish()
        if self._speed > 0.0:
            due = self._begin + progress.time / self._speed
            while (left := due - time.monotonic()) > 0.0 and not self._should_stop():
                time.sleep(min(left, NAP_S))

    def finish(self) -> None:
        """Show the end of the episode, and wait until an open page has it."""
        self._publish(is_over=True)
        with self._changed:
            if self._asked_lately():
                self._changed.wait_for(lambda: self._sent == self._version, ANSWER_S)

    def _asked_lately(self) -> bool:
        return time.monotonic() - self._asked < WATCHED_S

    def _publish(self, is_over: bool = False) -> None:
        begin = time.monotonic()
        shown, version = self._content(), self._version + 1
        news = {"version": version, "over": is_over, "page": shown.to_mapping(), "arrays": shown.packer.text()}
        text = json.dumps(news, allow_nan=False).encode()  # once, for all pages
        end = time.monotonic()
        self._next = end + max(SHORTEST_S, (end - begin) / SHARE)
        with self._changed:
            self._shown, self._news, self._version, self._is_over = shown, text, version, is_over
            self._changed.notify_all()

    def page(self) -> bytes:
        """Return the page with its present content."""
        with self._changed:
            shown, known = self._shown, self._page
        if known is None or known[0] is not shown:
            self._page = known = shown, render(shown, live=True).encode()
        return known[1]

    def answer(self, after: int) -> tuple[int, bytes]:
        """Return the version of the content, and JSON with content newer than `after`, as soon as there is some.

        Keys are `version`, `over` (whether the episode has ended), and, where there is newer content, `page` and
        `arrays` as in a report.
        """
        with self._changed:
            self._asked = time.monotonic()
            self._changed.wait_for(lambda: self._version > after or self._is_over, ANSWER_S)
            self._asked = time.monotonic()
            news, version, is_over = self._news, self._version, self._is_over
        return version, news if version > after else json.dumps({"version": version, "over": is_over}).encode()

    def delivered(self, version: int) -> None:
        """Note that a page has got a version."""
        with self._changed:
            self._sent = max(self._sent, version)
            self._changed.notify_all()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = 128  # connections that wait to be accepted; more are refused
    allow_reuse_address = os.name != "nt"  # on Windows two servers could otherwise share a port

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing: the terminal belongs to the progress of the run."""


def _handler_of(view: LiveView) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        """Handler of the page and of its requests for new content."""

        def do_GET(self) -> None:
            """Answer a request."""
            path, _, query = self.path.partition("?")
            after = VERSION.fullmatch(query or "after=0")
            if not OWN.fullmatch(self.headers.get("Host") or ""):  # another site's name that leads here
                self.send_error(HTTPStatus.FORBIDDEN)
            elif path == "/":
                self._send(view.page(), "text/html; charset=utf-8")
            elif path == "/content" and after:
                version, text = view.answer(int(after[1]))
                self._send(text, "application/json")
                view.delivered(version)
            else:
                self.send_error(HTTPStatus.NOT_FOUND)

        def _send(self, data: bytes, kind: str) -> None:
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, format: str, *args: Any) -> None:
            """Print nothing: stderr belongs to the progress of the run."""

        def handle(self) -> None:
            """Handle requests; what a page asks, or that it is closed meanwhile, is no error of the run."""
            try:
                super().handle()
            except (ConnectionError, ValueError):  # ValueError: bytes that are no request
                self.close_connection = True

    return Handler
