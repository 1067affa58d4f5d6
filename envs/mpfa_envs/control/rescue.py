"""A planner as the path out for a policy that stands at the same place again."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mpfa_envs.control.predictive import PredictiveControl
from mpfa_envs.control.standing import stands_still
from mpfa_envs.driver import Action, Driver, Errand, Senses, as_driver

if TYPE_CHECKING:
    from numpy.typing import NDArray

_SAME: Final = 1.0
"""Distance within which two places where a robot stood are the same [m]."""
_LED: Final = 4.0
"""Length of the path on which the planner leads it away, doubled each time [m]."""


@dataclass
class _Drive:
    """What is remembered of a robot's errand."""

    errand: Errand
    places: list[list[float]] = field(default_factory=list)  # since it stood last [m]
    stood: list[list[float]] = field(default_factory=list)  # where it did [m]
    left: float = 0.0  # of the path on which the planner leads it [m]
    next: float = _LED  # length of the next such path [m]


class Rescued:
    """A policy, or a driver, that a planner leads away where it stands still again.

    A robot that has not left a square of 0.1 m for ten seconds stands still. If that is within a
    meter of where it stood before, :class:`~mpfa_envs.planners.PredictiveControl` drives the next
    four meters; eight if it comes back and stands again, and so on. It needs a map, and keeps off
    obstacles by the filter of the errand.

    Args:
        policy: As for :func:`~mpfa_envs.run_tasks`.

    Examples:
        >>> import numpy as np
        >>> from mpfa_envs import evaluate
        >>> from mpfa_envs.control.rescue import Rescued
        >>> lazy = Rescued(lambda observations: np.zeros((len(observations), 2), np.float32))
        >>> task = {"robot": "kobuki", "physics": "kinematic", "memory": "map"}
        >>> [each.success for each in evaluate(lazy, "D", episodes=2, **task)]
        [True, True]
    """

    def __init__(self, policy: Action | Driver) -> None:
        self.policy = policy
        self._driver, self._planner = as_driver(policy), PredictiveControl()
        self.env_arguments: dict[str, Any] = dict(getattr(policy, "env_arguments", {}))
        """Those of the policy."""
        self._drives: dict[int, _Drive] = {}
        self._is_ready = False
        self.count = 0
        """How often the planner has taken over."""

    def leads(self, robot: int) -> bool:
        """Return True if the planner drives a robot now."""
        drive = self._drives.get(robot)
        return drive is not None and drive.left > 0.0

    def begin(self, robot: int, errand: Errand) -> None:
        """Prepare the driver and the planner for the errand of a robot.

        Raises:
            ValueError: If robots have no map, or the filter cannot keep this robot off obstacles.
        """
        self._driver.begin(robot, errand)
        self._planner.begin(robot, errand)
        self._drives[robot] = _Drive(errand)

    def drive(self, senses: Senses) -> NDArray[np.float32]:
        """The driver's actions, or the planner's for robots that it leads, ``[N, 2]``."""
        if not self._is_ready:
            # Its loops are compiled before they are needed.
            self._planner.drive(senses)
            self._is_ready = True
        actions = self._driver.drive(senses)
        places = senses.motions[:, :2].tolist()
        for row, robot in enumerate(senses.robots.tolist()):
            self._note(robot, places[row])
        led = np.array([self.leads(robot) for robot in senses.robots.tolist()], np.bool_)
        if led.any():
            actions = np.array(actions, np.float32)
            actions[led] = self._planner.drive(senses.of(led))
        return actions

    def _note(self, robot: int, place: list[float]) -> None:
        """Note where a robot is, and whether it is led from now on."""
        drive = self._drives[robot]
        if drive.left > 0.0:
            drive.left -= math.dist(place, drive.places[-1])
            drive.places = [place]
            return
        drive.places.append(place)
        errand = drive.errand
        if not stands_still(drive.places, errand.time_step * errand.action_repeat):
            return
        if any(math.dist(place, other) <= _SAME for other in drive.stood):
            drive.left, drive.next = drive.next, 2.0 * drive.next
            self.count += 1
            self._planner.begin(robot, errand)
        drive.stood.append(place)
        drive.places = [place]
