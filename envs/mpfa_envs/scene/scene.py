"""One moment of an episode from above, as a picture or in a live window."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from mpfa_envs.checks import check_positive
from mpfa_envs.robots.model import RobotModel
from mpfa_envs.scene.canvas import Canvas, Point
from mpfa_envs.scene.colors import MET, PATH, RAY, RAY_AREA, RIVAL, TRAIL
from mpfa_envs.sensing.map_memory import KnownMap
from mpfa_envs.worlds.world import World


def render_scene(
    world: World,
    *,
    robot: RobotModel,
    pose: tuple[float, float, float],
    goal: Point,
    goal_radius: float,
    trail: Sequence[Point] = (),
    rays: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
    known_map: KnownMap | None = None,
    walkers: NDArray[np.float64] | None = None,
    rival: tuple[tuple[float, float, float], Sequence[Point]] | None = None,
    size: int = 480,
) -> NDArray[np.uint8]:
    """Render one moment of an episode.

    Args:
        world: Its walls and obstacles.
        robot: The robot.
        pose: Pose of the robot (x, y, heading) [m, m, rad].
        goal: Position of the goal (x, y) [m].
        goal_radius: Distance that reaches the goal [m].
        trail: Its positions so far (x, y) [m].
        rays: Angles in the robot's frame [rad] and ranges [m] of its lidar.
        known_map: The robot's map, if it makes one.
        walkers: (x, y), the speeds in both directions and the radius [m, m/s] of each walker,
            ``[K, 5]``.
        rival: Pose and trail of a second robot in the same world, in another color.
        size: Longer side of the picture [px].

    Returns:
        Picture of shape ``[height, width, 3]``.

    Raises:
        ValueError: If the size is not an integer of at least 32.

    Examples:
        >>> from mpfa_envs import ROBOTS, WORLDS
        >>> from mpfa_envs.render import render_scene
        >>> render_scene(
        ...     WORLDS["B"], robot=ROBOTS["turtlebot2"], pose=(0.0, 0.0, 0.0), goal=(2.0, 3.0),
        ...     goal_radius=0.5,
        ... ).shape
        (480, 480, 3)
    """
    canvas = Canvas(world, size=size)
    x, y, heading = pose
    if known_map is not None:
        canvas.cells(known_map.blocked, known_map.resolution, MET)
        canvas.line([(x, y), *known_map.path], PATH, 1.5)
    if rays is not None:
        ends = [
            (x + reach * math.cos(heading + angle), y + reach * math.sin(heading + angle))
            for angle, reach in zip(rays[0].tolist(), rays[1].tolist(), strict=True)
        ]
        with canvas.layer():
            if len(ends) > 1:
                canvas.draw.polygon([canvas.at(*end) for end in ((x, y), *ends)], fill=RAY_AREA)
            for end in ends:
                canvas.line([(x, y), end], (*RAY[:3], 70), 0.7)
            for end in ends:
                canvas.disc(*end, 0.035, fill=RAY)
    canvas.goal(*goal, goal_radius)
    if rival is not None:
        canvas.line(rival[1], RIVAL, 2.0)
    canvas.line(trail, TRAIL, 2.0)
    for walker in () if walkers is None else walkers.tolist():
        canvas.walker(walker)
    if rival is not None:
        canvas.robot(*rival[0], robot.radius, RIVAL)
    canvas.robot(x, y, heading, robot.radius)
    return canvas.pixels()


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

    def is_hidden(self) -> bool:
        """Return True if there is no screen, and nobody asked for a window without one."""
        self._pygame.display.init()
        hidden = self._pygame.display.get_driver() in ("offscreen", "dummy")
        return hidden and "SDL_VIDEODRIVER" not in os.environ

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
