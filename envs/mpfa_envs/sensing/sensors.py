"""Sensors of your own beside the lidar, each of which adds a part to the observation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol, runtime_checkable

import numpy as np

from mpfa_envs.checks import check_count, check_number, check_positive, got, plain
from mpfa_envs.sensing.lidar import Lidar
from mpfa_envs.worlds.world import World

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.worlds.arrays import BatchArrays


class Sight(NamedTuple):
    """Where the robots of an environment are, as a sensor is told it."""

    motions: NDArray[np.float64]
    """Poses and speeds [m, m, rad, m/s, rad/s], ``[N, 5]``."""
    chosen: NDArray[np.bool_]
    """Which robots sense now, ``[N]``; what is given for the others is not looked at."""
    worlds: BatchArrays
    """The world of each robot with all that moves in it, as :meth:`mpfa_envs.Lidar.cast_all` takes
    it."""
    rngs: Sequence[np.random.Generator]
    """Source of randomness of each robot."""


@runtime_checkable
class Sensor(Protocol):
    """What a robot has beside its lidar: a further part of its observation.

    It keeps nothing from one call to the next: episodes that are loaded are driven again.
    """

    @property
    def width(self) -> int:
        """Number of values."""
        ...

    @property
    def bounds(self) -> tuple[float, float]:
        """The least and the greatest value."""
        ...

    @property
    def mirrored(self) -> Sequence[int] | None:
        """Places of the values in the mirror image of left and right; None: there is none."""
        ...

    def sense(self, sight: Sight) -> NDArray[np.floating[Any]]:
        """Sense with all robots; return values within the bounds, ``[N, width]``."""
        ...


@dataclass(frozen=True, kw_only=True)
class LidarSensor:
    """A second lidar: closeness ``min(closeness_distance / range, 1)`` of each of its sectors.

    The map, the filter and a :class:`~mpfa_envs.deploy.Pilot` do not know of it. With a latency it
    shows what is around the robot now, while the first lidar is seen from where orders will act.

    Args:
        mount: Its place (x, y) in the robot's frame [m] and where it looks, to the left [deg].
        sectors: Number of equal sectors of its field of view.
        field_of_view: Angle that it sees [deg].
        rays_per_sector: Rays of a sector, of which the nearest counts.
        max_range: Range of a ray that meets nothing [m].
        noise: Standard deviation of each ray [m].
        dropout: Chance that a ray reports the greatest range.
        closeness_distance: A range of this or less has closeness one [m].

    Raises:
        ValueError: If a number is out of its range.

    Examples:
        >>> from mpfa_envs import LidarSensor, NavigationEnv
        >>> rear = LidarSensor(mount=(-0.15, 0.0, 180.0), sectors=6, field_of_view=120.0)
        >>> env = NavigationEnv(world="A", physics="kinematic", sensors={"rear": rear})
        >>> observation, info = env.reset(seed=0)
        >>> observation[env.config.observation_slices["rear"]].shape
        (6,)
        >>> env.close()
    """

    mount: tuple[float, float, float] = (0.0, 0.0, 180.0)
    sectors: int = 18
    field_of_view: float = 180.0
    rays_per_sector: int = 3
    max_range: float = 10.0
    noise: float = 0.0
    dropout: float = 0.0
    closeness_distance: float = 0.25
    bounds: tuple[float, float] = field(default=(0.0, 1.0), init=False)
    """The least and the greatest value."""

    def __post_init__(self) -> None:
        mount = self.mount
        if not isinstance(mount, Sequence) or isinstance(mount, str) or len(mount) != 3:
            raise ValueError(f"mount must be x, y [m] and an angle [deg], got {mount!r}")
        x, y, angle = (check_number("mount", number) for number in mount)
        object.__setattr__(self, "mount", (x, y, angle))
        check_positive("closeness_distance", self.closeness_distance)
        _ = self._lidar

    @cached_property
    def _lidar(self) -> Lidar:
        # Of a robot that is turned as the sensor is.
        x, y, turn = *self.mount[:2], math.radians(self.mount[2])
        cosine, sine = math.cos(turn), math.sin(turn)
        return Lidar(
            World(name="empty"),
            sectors=self.sectors,
            rays_per_sector=self.rays_per_sector,
            max_range=self.max_range,
            noise=self.noise,
            dropout=self.dropout,
            field_of_view=self.field_of_view,
            mount=(x * cosine + y * sine, y * cosine - x * sine),
        )

    @property
    def width(self) -> int:
        """Number of values."""
        return self.sectors

    @property
    def mirrored(self) -> Sequence[int] | None:
        """Places of the values in the mirror image; None unless it looks ahead or back."""
        _, y, angle = self.mount
        symmetric = y == 0.0 and angle % 180.0 == 0.0
        return range(self.sectors - 1, -1, -1) if symmetric else None

    def sense(self, sight: Sight) -> NDArray[np.float64]:
        """Scan with all robots; return the closeness of each sector, ``[N, sectors]``."""
        lidar, motions = self._lidar, sight.motions.copy()
        motions[:, 2] += math.radians(self.mount[2])
        ranges = np.full((len(motions), lidar.angles.size), self.max_range)
        lidar.cast_all(motions, sight.chosen, sight.worlds, ranges)
        if lidar.is_noisy:
            for index in np.flatnonzero(sight.chosen).tolist():
                lidar.disturb(ranges[index], sight.rngs[index])
        nearest = ranges.reshape(len(ranges), self.sectors, -1).min(-1)
        return self.closeness_distance / np.maximum(nearest, self.closeness_distance)


SENSORS: Final[dict[str, Sensor]] = {}
"""Sensors by the names that tasks, settings and policies may have for them; empty at first."""


def resolve_sensors(sensors: Any) -> Mapping[str, Sensor]:
    """Find sensors: a mapping of them by name, or of what describes them, or names in SENSORS."""
    if isinstance(sensors, Mapping):
        found = {
            name: _find_described(name, each) if isinstance(each, Mapping) else each
            for name, each in sensors.items()
        }
    else:
        names = [sensors] if isinstance(sensors, str) else sensors or ()
        if not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
            raise ValueError(
                f"sensors must be objects by name, {{'rear': LidarSensor()}}, or names, got "
                f"{sensors!r}"
            )
        found = {name: _find(name) for name in names}
        if len(found) < len(names):
            raise ValueError(f"sensors must be named once each, got {list(names)}")
    for name, sensor in found.items():
        _check_sensor(name, sensor)
    return found


def _find(name: str) -> Sensor:
    """Find a sensor by its name."""
    if name not in SENSORS:
        raise ValueError(
            f"sensors must be names in SENSORS, {sorted(SENSORS)}, {got(name, SENSORS)}: "
            "register it first, in scripts by a plugin"
        )
    return SENSORS[name]


def _find_described(name: str, facts: Mapping[str, Any]) -> Sensor:
    """Make a second lidar as described, or find another sensor, which must be as described."""
    own = [entry.name for entry in fields(LidarSensor) if entry.init]
    # A class of a user may have the same name.
    if facts.get("kind") == LidarSensor.__name__ and {*own} <= facts.keys():
        return LidarSensor(**{entry: facts[entry] for entry in own})
    found = _find(name)
    present = (describe_sensors({name: found}) or {})[name]
    for entry in {*facts, *present}:
        if facts.get(entry) != present.get(entry):
            raise ValueError(
                f"sensors[{name!r}].{entry} must be {facts.get(entry)!r}, as when the policy "
                f"learned, got {present.get(entry)!r}"
            )
    return found


def _check_sensor(name: Any, sensor: Any) -> None:
    """Raise if an object is no sensor, or its numbers cannot be."""
    if not isinstance(name, str):
        raise ValueError(f"sensors must have text as names, got {name!r}")
    where = f"sensors[{name!r}]"
    if isinstance(sensor, type) or not isinstance(sensor, Sensor):
        raise ValueError(f"{where} must have width, bounds, mirrored and sense, got {sensor!r}")
    check_count(f"{where}.width", sensor.width)
    bounds, mirrored = sensor.bounds, sensor.mirrored
    if not isinstance(bounds, Sequence) or len(bounds) != 2:
        raise ValueError(f"{where}.bounds must be the least and the greatest, got {bounds!r}")
    low, high = (check_number(f"{where}.bounds", bound) for bound in bounds)
    if not low < high:
        raise ValueError(f"{where}.bounds must rise, got {bounds!r}")
    places = mirrored if isinstance(mirrored, Sequence) else []
    if mirrored is not None and sorted(places) != list(range(sensor.width)):
        raise ValueError(f"{where}.mirrored must have each place once, got {mirrored!r}")


def describe_sensors(sensors: Mapping[str, Sensor]) -> dict[str, Any] | None:
    """Plain values by name, which saved states must share; None without sensors."""
    described = {}
    for name, each in sensors.items():
        own: dict[str, Any] = (
            asdict(each) if is_dataclass(each) and not isinstance(each, type) else {}
        )
        mirrored = None if each.mirrored is None else list(each.mirrored)
        facts = {"kind": type(each).__name__, "width": each.width, "mirrored": mirrored}
        described[name] = {
            entry: [*value] if isinstance(value, tuple) else plain(value)
            for entry, value in {**own, **facts, "bounds": tuple(each.bounds)}.items()
            # Arrays and objects of a user are not compared.
            if isinstance(value, bool | int | float | str | tuple | list | None)
        }
    return described or None


def write_sensed(
    sensors: Mapping[str, Sensor], sight: Sight, observations: NDArray[np.float32]
) -> None:
    """Write what the chosen robots sense, one sensor after the other, to ``[N, widths]``."""
    first = 0
    for name, sensor in sensors.items():
        values = np.asarray(sensor.sense(sight))
        if values.shape != (len(observations), sensor.width):
            raise ValueError(
                f"sensors[{name!r}].sense must give {(len(observations), sensor.width)} values, "
                f"got {values.shape}"
            )
        low, high = sensor.bounds
        seen = values[sight.chosen]
        if not ((seen >= low) & (seen <= high)).all():
            raise ValueError(
                f"sensors[{name!r}].sense must give values in [{low:g}, {high:g}], got "
                f"{seen.min():g} to {seen.max():g}"
            )
        observations[sight.chosen, first : first + sensor.width] = seen
        first += sensor.width


def sense_with(
    sensors: Mapping[str, Sensor], index: int, sight: Sight, name: str
) -> NDArray[np.float32]:
    """Sense with one robot's sensor, by name; return its values, ``[width]``."""
    if name not in sensors:
        raise ValueError(f"name must be one of {sorted(sensors)}, {got(name, sensors)}")
    sensor, chosen = sensors[name], np.arange(len(sight.motions)) == index
    values = np.empty((len(chosen), sensor.width), np.float32)
    alone = sight._replace(motions=sight.motions.copy(), chosen=chosen)
    write_sensed({name: sensor}, alone, values)
    return values[index]
