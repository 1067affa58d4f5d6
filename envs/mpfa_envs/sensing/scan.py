"""The scan of a planar lidar, as whatever brings it hands it over."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Sequence
from contextlib import suppress
from numbers import Real
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


class ScanError(ValueError):
    """A scan lacks information that the policy needs; the message says which."""


class Scan(NamedTuple):
    """The measurements of a planar lidar, as in ``sensor_msgs/LaserScan``.

    A range of ``range_max`` or more, infinity too, has met nothing. One between 0 and
    ``range_min``, and minus infinity, has met something nearer than the sensor can measure. Zero,
    negative numbers and NaN are not valid.
    """

    angle_min: float
    """Direction of the first ray, from the sensor's x axis to the left [rad]."""
    angle_increment: float
    """From ray to ray; negative for a sensor that turns to the right [rad]."""
    ranges: ArrayLike
    """Shape ``[R]`` [m]."""
    range_min: float = 0.0
    """The least valid range [m]."""
    range_max: float = math.inf
    """The range up to which it sees [m]."""
    angle_max: float | None = None
    """Direction of the last ray [rad]; None: as many increments as there are ranges."""


def in_numbers(scan: Any) -> Scan:
    """Return a scan with ranges in double precision and plain numbers, which all else may be."""
    try:
        values = {name: getattr(scan, name) for name in Scan._fields}
    except AttributeError:
        raise ScanError(
            f"scan must have {', '.join(Scan._fields)}, got {reprlib.repr(scan)}"
        ) from None
    for name, value in values.items():
        if name == "ranges":
            values[name] = _numbers(name, value)
        elif value is not None or name != "angle_max":
            values[name] = check_real(name, value)
    return Scan(**values)


def check_real(name: str, value: Any) -> float:
    """Read one number, which may be infinite or NaN."""
    number = _numbers(name, value, "a real number")
    if number.ndim:
        raise ScanError(f"{name} must be a real number, got {reprlib.repr(value)}")
    return float(number)


def _numbers(name: str, value: Any, what: str = "real numbers") -> NDArray[np.float64]:
    """Read numbers of any real type, without text, truth values and masked ones among them."""
    entries = value if isinstance(value, Sequence) else [value]
    if not (np.ma.is_masked(value) or any(_is_none(each) for each in entries)):
        # Whatever turns into no array: ragged lists, tensors on another device, huge integers.
        with suppress(Exception):
            array = np.asarray(value)
            # Integers beyond 64 bits are objects.
            objects = array.flat if array.dtype.kind not in "iuf" else ()
            if all(isinstance(each, Real) and not _is_none(each) for each in objects):
                return array.astype(np.float64, copy=False)
    raise ScanError(f"{name} must be {what}, got {reprlib.repr(value)}")


def _is_none(entry: object) -> bool:
    """Return True for an entry of a list that NumPy takes for a number although it is none."""
    if type(entry) is float:  # Nearly always, and a scan may have thousands.
        return False
    kind = str(getattr(entry, "dtype", type(entry).__name__))
    masked = isinstance(entry, np.ma.MaskedArray) and bool(np.ma.is_masked(entry))
    return masked or kind.endswith("bool")
