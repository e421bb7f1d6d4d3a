"""A running episode in a browser: requests, content, speed, and the command."""

import json
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.training.report.conftest import ROOM
from tests.training.report.test_report_in_browser import clock, needs_browser, shown
from training.episodes.config import RunConfig
from training.episodes.runner import Progress, run_episode
from training.experiments.run_folder import RunFolder
from training.report.content import Content, live_content
from training.report.live import LiveView
from training.report.recording import EpisodeRecorder
from vslam_env import vslam_v0

STEPS = 60


def fetched(view: LiveView, path: str, host: str | None = None) -> str:
    """Return what the server answers."""
    request = urllib.request.Request(view.address + path, headers={} if host is None else {"Host": host})
    with urllib.request.urlopen(request, timeout=20.0) as answer:
        return str(answer.read().decode())


@pytest.fixture
def running() -> Iterator[tuple[LiveView, list[str]]]:
    """Return a view of a counter after its first step, with the titles that it may show next."""
    titles = ["first", "second"]
    with LiveView(0, 0.0) as view:
        view.shows(lambda: Content(title=titles[0]), lambda: True)
        view.on_step(Progress(0, 0.0, {}, ()))
        yield view, titles


def test_a_page_gets_newer_content_as_soon_as_there_is_some(running: tuple[LiveView, list[str]]) -> None:
    """The page has the present content; a request for newer content waits for it, and learns of the end."""
    view, titles = running
    assert "<title>first</title>" in fetched(view, "")
    assert "connect-src 'self'" in fetched(view, "")
    first = json.loads(fetched(view, "content?after=0"))
    assert (first["version"], first["over"], first["page"]["title"]) == (1, False, "first")
    later: list[Any] = []
    waiting = threading.Thread(target=lambda: later.append(json.loads(fetched(view, "content?after=1"))))
    waiting.start()
    titles.pop(0)
    time.sleep(0.3)
    assert not later
    view.on_step(Progress(1, 0.1, {}, ()))
    waiting.join(10.0)
    assert later[0]["page"]["title"] == "second"
    view.finish()
    assert json.loads(fetched(view, "content?after=2"))["over"]


def test_many_pages_that_do_not_read_share_one_text(running: tuple[LiveView, list[str]]) -> None:
    """Each of 200 connections is accepted while others wait; the content is made once; the view ends without them."""
    view, _ = running
    port = int(view.address.rsplit(":")[-1].strip("/"))
    pages = [socket.create_connection(("127.0.0.1", port), 20.0) for _ in range(200)]
    for page in pages:
        page.sendall(b"GET /content?after=0 HTTP/1.1\r\nHost: localhost\r\n\r\n")
    assert view.answer(0)[1] is view.answer(0)[1]
    assert json.loads(fetched(view, "content?after=0"))["page"]["title"] == "first"
    begin = time.monotonic()
    view.__exit__(None, None, None)
    assert time.monotonic() - begin < 5.0
    for page in pages:
        page.close()


def test_only_this_machine_is_answered(running: tuple[LiveView, list[str]]) -> None:
    """Other paths are not found, and requests under the name of another site are refused."""
    view, _ = running
    assert view.address.startswith("http://127.0.0.1:")
    for path, host, code in (("other", None, 404), ("content?after=x", None, 404), ("", "example.org", 403)):
        with pytest.raises(urllib.error.HTTPError) as error:
            fetched(view, path, host)
        with error.value:
            assert error.value.code == code


@pytest.mark.parametrize("host", ["LOCALHOST", "localhost.", "localhost:8765", "127.0.0.1:1", "[::1]", "[::1]:80"])
def test_all_names_of_this_machine_are_answered(running: tuple[LiveView, list[str]], host: str) -> None:
    """Letters, the final dot of a full name, and the port make no difference."""
    assert "<title>first</title>" in fetched(running[0], "", host)


def test_no_request_prints_or_ends_the_server(
    running: tuple[LiveView, list[str]], capfd: pytest.CaptureFixture[str]
) -> None:
    """Requests without sense are refused, and the terminal shows nothing of them."""
    view, _ = running
    port = int(view.address.rsplit(":", 1)[1].strip("/"))
    host = b"Host: 127.0.0.1\r\n\r\n"
    queries = [
        b"after=" + b"9" * 5000,
        b"after=" + b"1" * 12,
        "after=\u0663".encode(),
        b"after=-1",
        b"after=%31",
        b"after",
    ]
    for request in (
        *(b"GET /content?" + query + b" HTTP/1.1\r\n" + host for query in queries),
        b"GET http://[bad/ HTTP/1.1\r\n" + host, b"GET //[ HTTP/1.1\r\n" + host, b"\x16\x03\x01\x00\xff\r\n\r\n",
        b"GET / HTTP/9.9\r\n" + host, b"GET / HTTP/1.1\r\nHost: [\r\n\r\n",
        b"GET / HTTP/1.1\r\n" + b"A: b\r\n" * 200 + host,
        b"POST / HTTP/1.1\r\n" + host, b"GET /" + b"a" * 70_000 + b" HTTP/1.1\r\n" + host, b"GET\r\n\r\n", b"",
    ):  # fmt: skip
        with socket.create_connection(("127.0.0.1", port), timeout=20.0) as connection:
            connection.sendall(request)
            connection.shutdown(socket.SHUT_WR)
            while connection.recv(1 << 16):
                pass
    assert "<title>first</title>" in fetched(view, "")
    assert capfd.readouterr() == ("", "")


def test_content_is_made_only_while_a_page_is_open(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a request no step is packed; the speed is kept by waiting."""
    made: list[int] = []

    def content() -> Content:
        made.append(1)
        return Content(title="counted")

    stop = [False]
    with LiveView(0, 10.0) as view:
        view.shows(content, lambda: stop[0])
        begun = threading.Timer(0.3, lambda: fetched(view, "content?after=0"))
        begun.start()
        start = time.monotonic()
        view.on_step(Progress(0, 0.0, {}, ()))  # waits for the page
        assert time.monotonic() - start >= 0.3
        begun.join()
        start = time.monotonic()
        view.on_step(Progress(1, 2.0, {}, ()))
        assert 0.1 < time.monotonic() - start < 5.0
        count = len(made)
        monkeypatch.setattr("training.report.live.WATCHED_S", 0.0)
        stop[0] = True
        for step in range(2, 9):
            view.on_step(Progress(step, 1e4, {}, ()))
        assert len(made) == count


def test_a_taken_port_is_refused(refusal: Any) -> None:
    """The error names the port and the cure, before a folder is made or anything runs."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        line = refusal("run", "--live", "--port", str(port), "--max-cycles", "3", "--no-video")
    assert f"port: expected a free port of 127.0.0.1, got {port}. Choose another one with --port" in line


@pytest.mark.slow
@needs_browser
def test_a_browser_follows_the_episode(tmp_path: Path) -> None:
    """A page opened at the start plays up to the end of the episode, with its charts and merges, without an error."""
    config = RunConfig(robots=2, policy="random_walk", seed=3)
    folder = RunFolder.create(tmp_path / "run", "run", config.to_mapping(), 3)
    env = vslam_v0.parallel_env(world=ROOM, num_robots=2, max_cycles=STEPS, num_particles=13, oracle_merge=True)
    recorder = EpisodeRecorder(env, STEPS, 0.1)
    documents: list[str] = []
    with LiveView(0, 3.0) as view:
        view.shows(lambda: live_content(folder.path, "run", recorder.so_far()), lambda: False)

        def on_step(progress: Progress) -> None:
            recorder.on_step(progress)
            view.on_step(progress)

        browser = threading.Thread(target=lambda: documents.append(shown(view.address, "", tmp_path, seconds=3.0)))
        browser.start()
        record = run_episode(env, config.make_policies(env), config.seed, on_step)
        recorder.finish(record)
        view.finish()
        browser.join(120.0)
    (document,) = documents
    assert "The episode is over" in document
    assert "of 6.0 s" in document
    assert clock(document) > 4.0
    assert document.count("<svg") == 4
    assert "maps of 0 and 1 merged" in document
