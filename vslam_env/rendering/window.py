"""Window for `render_mode="human"`, with keyboard input."""

import os
import sys
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray


def display_unavailable_reason() -> str:
    """Return why no window can be opened, with a hint; an empty string if one can be opened."""
    try:
        import pygame  # noqa: F401
    except ImportError:
        return "pygame is not installed. Install the extra: pip install 'vslam-env[viz]'"
    named = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"))
    if named or sys.platform in ("win32", "darwin"):
        return ""
    return "there is no display. Use render_mode='rgb_array' for pictures, or `vslam run` for a video"


class Window:
    """Window that shows frames; without pygame or a display it warns once and shows nothing.

    Attributes:
        held: Names of the keys held down at the last frame.
        typed: Names of the keys pressed since the previous frame, in order.
        closed: Whether the user has closed the window; it then shows no more frames.
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
        """Close the window; a later `show` opens a new one, unless the user closed it."""
        if self._surface is not None:
            self._pygame.display.quit()
            self._surface = None
        self.held.clear()

    def _read_keys(self) -> None:
        """Update the keys, and close the window if the user has closed it."""
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
