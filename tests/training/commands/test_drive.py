"""`vslam drive`: keys become actions, in a window of a dummy display."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from agents import make_policy
from training.cli import app
from training.episodes.teleoperation import action_of, drive
from vslam_env import vslam_v0
from vslam_env.rendering.window import Window

runner = CliRunner()


class _Script:
    """Display whose user holds and types given keys, frame by frame, and then closes it."""

    def __init__(self, frames: list[tuple[set[str], list[str]]]) -> None:
        self.frames = list(frames)
        self.held: set[str] = set()
        self.typed: list[str] = []
        self.closed = False
        self.shown: list[Any] = []

    def show(self, frame: Any) -> None:
        """Take the frame, and press the next keys."""
        self.shown.append(frame)
        if self.frames:
            self.held, self.typed = self.frames.pop(0)
        else:
            self.closed = True


@pytest.mark.parametrize(
    ("held", "action"),
    [
        (set(), [0, 0]),
        ({"up"}, [1, 0]),
        ({"s"}, [-1, 0]),
        ({"w", "a"}, [1, 1]),
        ({"right"}, [0, -1]),
        ({"left", "d", "down"}, [-1, 0]),
        ({"x"}, [0, 0]),
    ],
)
def test_keys_are_mapped_to_actions(held: set[str], action: list[float]) -> None:
    """Arrows and WASD are speed and turn; opposite keys cancel; other keys do nothing."""
    assert action_of(held).tolist() == action


def test_keys_drive_one_robot_and_tab_selects_the_next() -> None:
    """The selected robot drives ahead, the others stand or follow their policy; Tab selects the next robot."""
    env = vslam_v0.parallel_env(world="fig5", num_robots=2, num_particles=5)
    screen = _Script([({"up"}, [])] * 5 + [(set(), ["tab"])] + [({"up"}, [])] * 4)
    infos = drive(env, screen, {}, 3, pace=0.0)
    assert env.episode.tick == 10
    ways = np.abs(np.diff(np.array(env.episode.true_path)[:, :, :2], axis=0)).sum(axis=2)
    assert (ways[:5, 0] > 0.01).any()
    assert (ways[:5, 1] == 0.0).all()
    assert (ways[5:, 0] == 0.0).all()
    assert (ways[6:, 1] > 0.01).any()
    assert len(screen.shown) == 11
    assert screen.shown[0].shape == (720, 960, 3)
    assert infos["robot_0"]["distance"] > 0.0
    policies = {agent: make_policy("random_walk", "continuous") for agent in env.possible_agents}
    drive(env, _Script([(set(), [])] * 5), policies, 3, pace=0.0)
    assert env.episode.team_metrics().distances[1] > 0.0


def test_escape_ends() -> None:
    """Escape ends the episode at once."""
    env = vslam_v0.parallel_env(world="fig5", num_robots=1, num_particles=5)
    drive(env, _Script([(set(), []), (set(), ["escape"]), (set(), [])]), {}, 3, pace=0.0)
    assert env.episode.tick == 1


def test_a_window_reads_keys_and_close_events(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pressed keys are held until released; the close button closes the window for good."""
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    window, frame = Window("test"), np.zeros((120, 160, 3), np.uint8)
    window.show(frame)

    def post(*events: Any) -> None:
        for kind, key in events:
            pygame.event.post(pygame.event.Event(kind, {"key": key}) if key else pygame.event.Event(kind))

    post((pygame.KEYDOWN, pygame.K_UP), (pygame.KEYDOWN, pygame.K_a))
    window.show(frame)
    assert window.held == {"up", "a"}
    assert window.typed == ["up", "a"]
    post((pygame.KEYUP, pygame.K_UP))
    window.show(frame)
    assert (window.held, window.typed) == ({"a"}, [])
    post((pygame.QUIT, None))
    window.show(frame)
    assert window.closed
    window.show(frame)  # the window stays closed
    window.close()


def test_the_command_needs_a_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a display or pygame the command reports what is missing, before it compiles anything."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    result = runner.invoke(app, ["drive", "--world", "fig5"])
    assert isinstance(result.exception, ValueError)
    assert "drive: expected a display for a window" in str(result.exception)


def test_the_command_records_a_video(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """With a dummy display the command runs to the end, prints a summary, and writes a video."""
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    film = tmp_path / "drive.mp4"
    arguments = ["drive", "--world", "fig5", "--robots", "2", "--max-cycles", "3", "--record", str(film)]
    result = runner.invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert film.stat().st_size > 1000
    assert "robot_1: E " in result.output
