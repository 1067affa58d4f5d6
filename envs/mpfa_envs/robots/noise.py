"""Errors of a real robot: of lidar, wheels, time and odometry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mpfa_envs.checks import check_count, check_not_negative, check_number, check_share, keep

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MOST_SLIP = 0.45
"""At a larger mean a wheel could lose nearly all of its path."""


@dataclass(frozen=True, kw_only=True)
class RobotNoise:
    """Errors of a real robot; none by default.

    The task is judged by true positions: success, collision, reward and info have no errors.

    Args:
        range_noise: Standard deviation of the Gaussian error of each ray of the lidar [m].
        dropout: Chance that a ray comes back with nothing and reports the lidar's greatest range.
        slip: Mean share of its path that a wheel loses, uniform from none to twice this, sampled
            for each wheel and time step. Odometry, which counts the turns of the wheels, does not
            see it.
        latency: Time steps after which an action reaches the wheels; until the first one does, the
            robot stands.
        drift: Standard deviation of the share by which odometry measures paths too long or too
            short, and of that by which it measures turns; the two are sampled for each episode. The
            goal's direction and distance, the speeds and the robot's map are by odometry.

    Raises:
        ValueError: If a number is out of its range.

    Examples:
        >>> from mpfa_envs import NavigationEnv, RobotNoise
        >>> noise = RobotNoise(range_noise=0.02, dropout=0.02, slip=0.05, latency=1, drift=0.02)
        >>> env = NavigationEnv(world="B", physics="kinematic", noise=noise)
        >>> observation, info = env.reset(seed=0)
        >>> noise.times(2).slip, noise.times(2).latency
        (0.1, 2)
    """

    range_noise: float = 0.0
    dropout: float = 0.0
    slip: float = 0.0
    latency: int = 0
    drift: float = 0.0

    def __post_init__(self) -> None:
        for name in ("range_noise", "drift"):
            check_not_negative(name, getattr(self, name))
        check_share("dropout", self.dropout)
        if not 0.0 <= check_number("slip", self.slip) <= _MOST_SLIP:
            raise ValueError(f"slip must be in [0, {_MOST_SLIP}], got {self.slip!r}")
        check_count("latency", self.latency, least=0)
        keep(self, *vars(self))

    def times(self, factor: float) -> RobotNoise:
        """Scale all errors.

        Args:
            factor: What they are multiplied by; time steps are rounded.

        Returns:
            The scaled noise.

        Raises:
            ValueError: If an error is out of its range then.
        """
        scaled = {name: factor * value for name, value in asdict(self).items()}
        return RobotNoise(**{**scaled, "latency": round(scaled["latency"])})

    @property
    def is_in_motion(self) -> bool:
        """True if more than the lidar is noisy."""
        return self.slip > 0.0 or self.latency > 0 or self.drift > 0.0


def resolve_noise(noise: RobotNoise | Mapping[str, Any] | None) -> RobotNoise:
    """Read an argument of an environment."""
    if noise is None:
        return RobotNoise()
    if isinstance(noise, RobotNoise):
        return noise
    try:
        return RobotNoise(**noise)
    except TypeError as error:
        raise ValueError(
            f"noise must be a RobotNoise or hold arguments of it, got {noise!r}: {error}"
        ) from error


class NoisyMotion:
    """Latency and slip of many robots' wheels, and their odometry."""

    def __init__(
        self, noise: RobotNoise, robots: int, *, wheel_base: float, time_step: float
    ) -> None:
        self._noise = noise
        self._wheel_base = wheel_base
        self._time_step = time_step
        self.has_odometry = noise.slip > 0.0 or noise.drift > 0.0
        """True if odometry may differ from the true poses."""
        self._commands = np.zeros((robots, noise.latency + 1, 2))
        self._kept = np.ones((robots, 2))
        self._scales = np.ones((robots, 2))
        self._poses = np.zeros((robots, 3))
        self.odometry = np.zeros((robots, 5))
        """Poses and speeds (x, y, heading, forward, turning) by odometry, ``[N, 5]``."""

    def begin(self, index: int, pose: Sequence[float], rng: np.random.Generator) -> None:
        """Start an episode of a robot at a pose [m, m, rad] that it knows."""
        self._commands[index] = 0.0
        self._kept[index] = 1.0
        self._poses[index] = pose
        self.odometry[index] = *pose, 0.0, 0.0
        if self._noise.drift > 0.0:
            self._scales[index] = 1.0 + self._noise.drift * rng.standard_normal(2)

    def drive(
        self,
        speeds: NDArray[np.float64],  # [N, 2] [m/s]
        running: NDArray[np.bool_],  # [N]
        rngs: Sequence[np.random.Generator],
    ) -> NDArray[np.float64]:
        """Speeds of the wheels over the ground [m/s], ``[N, 2]``, from the commanded ones."""
        self._commands[running, :-1] = self._commands[running, 1:]
        self._commands[running, -1] = speeds[running]
        due = self._commands[:, 0]
        if self._noise.slip == 0.0:
            return due.copy()
        for index in np.flatnonzero(running).tolist():
            self._kept[index] = 1.0 - 2.0 * self._noise.slip * rngs[index].random(2)
        return due * self._kept

    def measure(self, motions: NDArray[np.float64], running: NDArray[np.bool_]) -> None:
        """Update the odometry after a time step to motions ``[N, 5]``."""
        if not self.has_odometry:
            return
        before, now = self._poses[running], motions[running, :3]
        turned = _wrapped(now[:, 2] - before[:, 2])
        driven = _arc(now[:, :2] - before[:, :2], before[:, 2], turned)
        # The paths that the wheels have turned: those driven and those lost.
        across = 0.5 * turned * self._wheel_base
        left, right = (np.stack((driven - across, driven + across), axis=1) / self._kept[running]).T
        driven = 0.5 * (left + right) * self._scales[running, 0]
        turned = (right - left) / self._wheel_base * self._scales[running, 1]
        held = self.odometry[running]
        middle = held[:, 2] + 0.5 * turned
        chord = driven * np.sinc(0.5 * turned / np.pi)
        held[:, 0] += chord * np.cos(middle)
        held[:, 1] += chord * np.sin(middle)
        held[:, 2] = _wrapped(held[:, 2] + turned)
        held[:, 3], held[:, 4] = driven / self._time_step, turned / self._time_step
        self.odometry[running] = held
        self._poses[running] = now


def _wrapped(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles in [-π, π] [rad]."""
    return angles - 2.0 * np.pi * np.rint(angles / (2.0 * np.pi))


def _arc(
    steps: NDArray[np.float64], headings: NDArray[np.float64], turned: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Lengths of the arcs along steps ``[N, 2]`` [m], negative if backwards, ``[N]``."""
    middle = headings + 0.5 * turned
    chord = steps[:, 0] * np.cos(middle) + steps[:, 1] * np.sin(middle)
    return chord / np.sinc(0.5 * turned / np.pi)
