"""A window on the screen for `render_mode="human"`, where there is a screen, and the keys that are pressed in it."""

import os
import sys
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray


def display_unavailable_reason() -> str:
    """Return why no window can be opened here, with the cure; the empty string where one can."""
    try:
        import pygame  # noqa: F401
    except ImportError:
        return "pygame is not installed. Install the extra: pip install 'vslam-env[viz]'"
    named = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"))
    if named or sys.platform in ("win32", "darwin"):
        return ""
    return "there is no screen. Without one, render_mode='rgb_array' gives pictures and `vslam run` a video"


class Window:
    """Shows frames; without pygame or a screen it says so once and shows nothing.

    Attributes:
        held: Names of the keys that are held down, as of the last frame.
        typed: Names of the keys that went down since the frame before, in order.
        closed: Whether the user has closed the window; it shows nothing more then.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._pygame: Any = None
        self._surface: Any = None
        self._useless = False
        self.held: set[str] = set()
        self.typed: list[str] = []
        self.closed = False

    def show(self, frame: NDArray[np.uint8]) -> None:
        """Show a frame (H, W, 3) uint8 RGB."""
        if self._surface is None and not self._useless and not self.closed:
            self._open(frame.shape[1], frame.shape[0])
        if self._surface is not None:
            self._read_keys()
        if self._surface is not None:
            self._pygame.surfarray.blit_array(self._surface, frame.swapaxes(0, 1))
            self._pygame.display.flip()

    def close(self) -> None:
        """Close the window; a later `show` opens another one, unless the user closed it."""
        if self._surface is not None:
            self._pygame.display.quit()
            self._surface = None
        self.held.clear()

    def _read_keys(self) -> None:
        """Take note of the keys and of the window's own cross."""
        pygame = self._pygame
        self.typed = []
        for event in pygame.event.get():
            if event.type == pygame.QUIT:
                self.closed = True
            elif event.type == pygame.KEYDOWN:
                self.held.add(pygame.key.name(event.key))
                self.typed.append(pygame.key.name(event.key))
            elif event.type == pygame.KEYUP:
                self.held.discard(pygame.key.name(event.key))
        if self.closed:
            self.close()

    def _open(self, width: int, height: int) -> None:
        reason = display_unavailable_reason()
        if reason:
            self._useless = True
            warnings.warn(f"render_mode='human' shows nothing: {reason}.", stacklevel=4)
            return
        import pygame

        self._pygame = pygame
        pygame.display.init()
        self._surface = pygame.display.set_mode((width, height))
        pygame.display.set_caption(self._title)
