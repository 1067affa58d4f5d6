"""A live window, which pygame opens; the extra ``live`` brings it."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from mpfa_envs.checks import check_positive


class Window:
    """A window that opens with the first picture and knows the keys that are held."""

    # Without a screen, SDL_VIDEODRIVER=dummy lets it run and show nothing.

    def __init__(self, title: str, *, fps: float) -> None:
        try:
            import pygame
        except ImportError as error:
            raise DependencyNotInstalled(
                "a live window needs pygame: install the extra 'live', see Install in the README"
            ) from error
        # A picture needs no 3D, and a driver that renders in software brings another LLVM:
        # importing PyTorch's Triton after that ends the process.
        os.environ.setdefault("SDL_FRAMEBUFFER_ACCELERATION", "0")
        self._pygame: Any = pygame
        self._title = title
        self._fps = check_positive("fps", fps)
        self._screen: Any = None
        self._clock: Any = None
        self.keys: set[str] = set()
        """Names of the keys that are held."""
        self.pressed: list[str] = []
        """Names of the keys that were pressed since the last picture."""
        self.closed = False
        """Set once the user has closed it or pressed Escape; it shows nothing more then."""

    def show(self, picture: NDArray[np.uint8]) -> bool:
        """Show a picture, ``[height, width, 3]``, when due; return True if the window is open."""
        if self.closed:
            return False
        pygame = self._pygame
        size = picture.shape[1], picture.shape[0]
        if self._screen is None or self._screen.get_size() != size:
            pygame.display.init()
            pygame.display.set_caption(self._title)
            self._screen = pygame.display.set_mode(size)
            self._clock = self._clock or pygame.time.Clock()
        pygame.surfarray.blit_array(self._screen, picture.swapaxes(0, 1))
        pygame.display.flip()
        self._listen()
        self._clock.tick(self._fps)
        return not self.closed

    def _listen(self) -> None:
        pygame = self._pygame
        self.pressed = []
        for event in pygame.event.get():
            if event.type == pygame.QUIT:
                self.closed = True
            elif event.type in (pygame.KEYDOWN, pygame.KEYUP):
                name = pygame.key.name(event.key)
                if event.type == pygame.KEYUP:
                    self.keys.discard(name)
                    continue
                self.keys.add(name)
                self.pressed.append(name)
                self.closed = self.closed or name == "escape"
        if self.closed:
            self.close()

    def close(self) -> None:
        """Close it; a second call does nothing."""
        self.closed = True
        self.keys.clear()
        if self._screen is not None:
            self._pygame.display.quit()
            self._screen = None
