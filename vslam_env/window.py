"""A window on the screen for `render_mode="human"`, where there is a screen."""

import os
import sys
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray


def _screen_is_there() -> bool:
    if sys.platform in ("win32", "darwin"):
        return True
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"))


class Window:
    """Shows frames; without pygame or a screen it says so once and shows nothing."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._pygame: Any = None
        self._surface: Any = None
        self._useless = False

    def show(self, frame: NDArray[np.uint8]) -> None:
        """Show a frame (H, W, 3) uint8 RGB."""
        if self._surface is None and not self._useless:
            self._open(frame.shape[1], frame.shape[0])
        if self._surface is not None:
            self._pygame.event.pump()
            self._pygame.surfarray.blit_array(self._surface, frame.swapaxes(0, 1))
            self._pygame.display.flip()

    def close(self) -> None:
        """Close the window; a later `show` opens another one."""
        if self._surface is not None:
            self._pygame.display.quit()
            self._surface = None

    def _open(self, width: int, height: int) -> None:
        try:
            import pygame
        except ImportError:
            reason = "pygame is not installed. Install the extra: pip install 'vslam-env[viz]'"
        else:
            reason = "" if _screen_is_there() else "there is no screen. Use render_mode='rgb_array'"
        if reason:
            self._useless = True
            warnings.warn(f"render_mode='human' shows nothing: {reason}.", stacklevel=4)
            return
        self._pygame = pygame
        pygame.display.init()
        self._surface = pygame.display.set_mode((width, height))
        pygame.display.set_caption(self._title)
