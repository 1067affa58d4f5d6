"""Checks of arguments, with errors that name the argument and the value."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from operator import index
from typing import Any, Final, get_args

MOST: Final = 100_000
"""Largest count by default: robots, episodes, worlds, rays and scans are made one by one or held at
once, and a typing error must not take all time or memory."""
_SLIPS: Final[Mapping[str, Mapping[str, float]]] = {
    "m": {"millimeters": 1e-3, "centimeters": 1e-2},
    "m/s": {"mm/s": 1e-3, "cm/s": 1e-2},
    "m/s²": {"mm/s²": 1e-3, "cm/s²": 1e-2},
    "rad": {"degrees": math.pi / 180.0},
    "rad/s": {"deg/s": math.pi / 180.0},
    "rad/s²": {"deg/s²": math.pi / 180.0},
    "deg": {"radians": 180.0 / math.pi},
    "kg": {"grams": 1e-3},
    "s": {"milliseconds": 1e-3},
}
"""Units that are taken for others, and their size in these."""
MEANT: Final[Mapping[str, tuple[float, float, str]]] = {
    **dict.fromkeys(("radius", "height", "wheel_base"), (0.01, 5.0, "m")),
    "wheel_radius": (0.001, 2.0, "m"),
    "mass": (0.01, 2000.0, "kg"),
    **dict.fromkeys(("min_wheel_speed", "max_wheel_speed"), (1e-3, 20.0, "m/s")),
    "speeds": (0.0, 20.0, "m/s and rad/s"),
    **dict.fromkeys(("wheel_acceleration", "acceleration", "deceleration"), (1e-3, 100.0, "m/s²")),
    "turn_limit": (0.01, 20.0, "rad/s"),
    "turn_acceleration": (0.01, 100.0, "rad/s²"),
    "field_of_view": (7.0, 360.0, "deg"),
    **dict.fromkeys(("lidar_range", "max_range"), (0.1, 300.0, "m")),
    "offset": (0.0, 5.0, "m"),
    **dict.fromkeys(("yaw", "heading"), (0.0, 2.0 * math.pi, "rad")),
    **dict.fromkeys(("clearance", "stop_distance"), (0.0, 5.0, "m")),
    "range_noise": (0.0, 1.0, "m"),
    "goal_radius": (0.01, 5.0, "m"),
    **dict.fromkeys(("closeness_distance", "look_ahead"), (0.01, 20.0, "m")),
    **dict.fromkeys(("unseen", "min_goal_distance", "max_goal_distance"), (0.01, 1000.0, "m")),
    "map_size": (1.0, 1000.0, "m"),
    **dict.fromkeys(("time_step", "check_period"), (1e-4, 10.0, "s")),
    "latency": (0.0, 5.0, "s"),
    **dict.fromkeys(
        ("goal_reward", "collision_reward", "progress_scale", "step_cost"), (0.0, 1e9, "")
    ),
    **dict.fromkeys(("scan_timeout", "odometry_timeout", "command_timeout"), (1e-3, 60.0, "s")),
}
"""Least and greatest size that a number can be meant to have, wherever it is given, and its unit;
zero is for other checks."""


def check_meant(name: str, value: float, quantity: str = "") -> None:
    """Reject a number of a size that nobody means, as in another unit."""
    least, most, unit = MEANT.get(quantity or name.rpartition(".")[2], (0.0, math.inf, ""))
    if not value or least <= abs(value) <= most:
        return
    guesses = [(value * factor, other) for other, factor in _SLIPS.get(unit, {}).items()]
    within = [each for each in guesses if least <= abs(each[0]) <= most]
    hint, middle = "", math.sqrt(max(least, 1e-3) * most)
    if within:
        meant, other = min(within, key=lambda each: abs(math.log(abs(each[0]) / middle)))
        hint = f"; did you mean {meant:.4g}, which is {value:g} {other}?"
    bound = f"at least {least:.4g}" if abs(value) < least else f"at most {most:.4g}"
    size = " ".join(filter(None, (bound, unit)))
    raise ValueError(f"{name} must be {size} in size, got {value:g}{hint}")


def check_number(name: str, value: Any) -> float:
    """A finite number, of a size that can be meant."""
    if isinstance(value, (bool, str, bytes)):
        raise ValueError(f"{name} must be a finite number, got {value!r}")
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{name} must be a finite number, got {value!r}")
    check_meant(name, number)
    return number


def plain(value: Any) -> Any:
    """A number of Python's own in the place of one of NumPy's, which no saved state may hold."""
    return value.item() if hasattr(value, "item") else value


def keep(record: Any, *names: str) -> None:
    """Put plain numbers in the fields of a dataclass, also of a frozen one."""
    for name in names:
        object.__setattr__(record, name, plain(getattr(record, name)))


def all_finite(values: Iterable[Any]) -> bool:
    """Return True if all are finite numbers, which text and truth values are not."""
    try:
        return all(math.isfinite(value) and not isinstance(value, bool) for value in values)
    except (TypeError, ValueError, OverflowError):
        return False


def check_positive(name: str, value: Any) -> float:
    """A finite number above zero."""
    number = check_number(name, value)
    if number <= 0.0:
        raise ValueError(f"{name} must be positive, got {value!r}")
    return number


def check_not_negative(name: str, value: Any) -> float:
    """A finite number that is zero or above."""
    number = check_number(name, value)
    if number < 0.0:
        raise ValueError(f"{name} must not be negative, got {value!r}")
    return number


def check_share(name: str, value: Any) -> float:
    """A number in [0, 1]."""
    number = check_number(name, value)
    if not 0.0 <= number <= 1.0:
        raise ValueError(f"{name} must be in [0, 1], got {value!r}")
    return number


def check_count(name: str, value: Any, *, least: int = 1, most: float = MOST) -> int:
    """An integer from ``least`` to ``most``."""
    try:
        number = None if isinstance(value, bool) else index(value)
    except TypeError:
        number = None
    if number is None or number < least:
        what = "a positive integer" if least == 1 else f"an integer of at least {least}"
        raise ValueError(f"{name} must be {what}, got {value!r}")
    if number > most:
        raise ValueError(f"{name} must be at most {most}, got {value!r}")
    return number


def check_choice(name: str, value: Any, kinds: Any) -> Any:
    """One of the values of a ``Literal``."""
    if value not in get_args(kinds):
        raise ValueError(f"{name} must be one of {get_args(kinds)}, got {value!r}")
    return value


def check_bool(name: str, value: Any) -> bool:
    """True or False."""
    if value not in (True, False):
        raise ValueError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def check_seed(value: Any) -> int:
    """An integer of any size that is not negative."""
    return check_count("seed", value, least=0, most=math.inf)


def got(value: object, known: Iterable[str]) -> str:
    """What was given in place of a known name, and the nearest of them."""
    question = did_you_mean(value, known)
    return f"got {value!r} ({question})" if question else f"got {value!r}"


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """A question about the nearest known name; empty if none is near."""
    near = get_close_matches(str(name), list(known), n=1)
    return f"did you mean {near[0]!r}?" if near else ""
