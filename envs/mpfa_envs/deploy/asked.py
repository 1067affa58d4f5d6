"""A driver on a robot: what it is told of the drive, and of each decision."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mpfa_envs.driver import Action, Driver, Errand, Senses, as_driver

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from mpfa_envs.deploy.card import Card
    from mpfa_envs.deploy.ground import Ground
    from mpfa_envs.safety.filter import SafetyFilter


class Asked:
    """A policy or a planner that is asked for the actions of one robot, its number 0."""

    def __init__(
        self,
        driver: Action | Driver,
        card: Card,
        ground: Ground,
        make_filter: Callable[[], SafetyFilter],
    ) -> None:
        self._driver, self._card, self._ground = as_driver(driver), card, ground
        self._make_filter = make_filter
        self._told = False

    def begin(self) -> None:
        """The drive, or its map, has begun."""
        self._told = False

    @property
    def is_led(self) -> bool:
        """True if a planner drives where a policy stood still."""
        leads = getattr(self._driver, "leads", None)
        return leads is not None and bool(leads(0))

    def act(
        self,
        rows: NDArray[np.float32],  # observations in the states that it may be in, [S, O]
        states: NDArray[np.float32],  # the same, as a filter reads them
        motions: NDArray[np.float64],  # these states, [S, 5]
        goal: tuple[float, float],  # [m]
        radius: float,  # of the goal [m]
    ) -> NDArray[np.float32]:
        """The driver's action, ``[2]``."""
        card, grid = self._card, self._ground.map
        if not self._told:
            x, y, heading = motions[0, :3].tolist()
            world, pose = self._ground.known()
            errand = Errand(
                start=(x, y, heading),
                goal=goal,
                goal_radius=radius,
                time_step=card.period / card.action_repeat,
                action_repeat=card.action_repeat,
                make_filter=self._make_filter,
                map_shape=None if grid is None else grid.shape,
                world=world,
                world_pose=pose,
            )
            self._driver.begin(0, errand)
            self._told = True
        senses = Senses(
            robots=np.zeros(1, np.int64),
            observations=rows[:1],
            states=states[None],
            motions=motions[:1],
            poses=motions[:1, :3],
            goals=np.array([goal]),
            maps=None if grid is None else grid.arrays,
        )
        action = self._driver.drive(senses)[0]
        if not np.isfinite(action).all():
            raise ValueError(f"the network's action must be finite, got {action}")
        return action


def rescued(driver: Action | Driver) -> Action | Driver:
    """Return a driver that predictive control leads away where the robot stands still again."""
    # It needs Numba, as a map does.
    from mpfa_envs.control.predictive import PredictiveControl
    from mpfa_envs.control.rescue import Rescued

    return driver if isinstance(driver, PredictiveControl) else Rescued(driver)
