"""An exported policy: its card, which says what it senses and may do, and its network."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial, reduce
from operator import getitem
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mpfa_envs.checks import check_choice, check_count, check_number, check_positive
from mpfa_envs.files import cause_of, read_file
from mpfa_envs.robots.model import RobotModel
from mpfa_envs.sensing.lidar import Reduction
from mpfa_envs.sensing.observation import (
    DISTANCE_SCALE,
    GOAL_CLOSENESS_DISTANCE,
    PATH_BOUND,
    SPEED_BOUND,
    Memory,
    observation_slices,
)

if TYPE_CHECKING:
    import os

    from numpy.typing import NDArray

FORMAT: Final = 1
SCALES: Final = {
    "goal_closeness_distance": GOAL_CLOSENESS_DISTANCE,
    "distance": DISTANCE_SCALE,
    "speed_bound": SPEED_BOUND,
    "way_bound": PATH_BOUND,
}
"""The scales of the observation that are the same for all policies, as cards have them."""
_ENTRIES: Final[Mapping[str, tuple[str, Callable[[str, Any], Any]]]] = {
    "observation_size": ("observation.size", check_count),
    "action_size": ("action.size", check_count),
    "sectors": ("lidar.sectors", check_count),
    "field_of_view": ("lidar.field_of_view", check_positive),
    "reduction": ("lidar.reduction", partial(check_choice, kinds=Reduction)),
    "max_range": ("lidar.max_range", check_positive),
    "closeness_distance": ("scales.closeness_distance", check_positive),
    "memory": ("memory", partial(check_choice, kinds=Memory)),
    "history": ("history", partial(check_count, least=0)),
    "robot": ("robot", lambda _, values: RobotModel.from_fields(values)),
    "period": ("limits.period", check_positive),
    "goal_radius": ("limits.goal_radius", check_positive),
    "env_arguments": ("env_arguments", lambda _, values: dict(values)),
    "training": ("training", lambda _, values: dict(values)),
}
"""Entry of each field in the JSON file, and the check that reads it."""
_LARGEST = 2**28
"""A file larger than this is no policy [bytes]."""
_LARGEST_CARD = 2**24
"""Nor is this one a card: parsed JSON may take fifty times its size [bytes]."""


class CardError(ValueError):
    """A policy, its card and a robot do not fit together; the message says why."""


@dataclass(frozen=True)
class Card:
    """The facts about a policy that a robot needs in order to run it.

    The angles of the lidar's sectors and the scales of the observation are those of
    :class:`~mpfa_envs.NavigationEnv`; a card with others is rejected.
    """

    observation_size: int
    action_size: int
    sectors: int
    """Equal sectors of the field of view, left to right."""
    field_of_view: float
    """Angle that the sectors cover, which the robot's front halves [degrees]."""
    reduction: str
    """The range of a sector by its rays: ``min``, ``median``, or ``single``, the middle one."""
    max_range: float
    """Range of a sector that meets nothing [m]."""
    closeness_distance: float
    """A range of this or less has closeness one [m]."""
    memory: str
    """``map``: it senses the path over a map that it makes; or ``none``."""
    history: int
    """Earlier scans that it senses."""
    robot: RobotModel
    """The robot that it learned with."""
    period: float
    """Time from decision to decision [s]."""
    goal_radius: float
    """Distance from the goal at which it has arrived [m]."""
    env_arguments: Mapping[str, Any]
    """Arguments of :class:`~mpfa_envs.NavigationEnv` under which it learned."""
    training: Mapping[str, Any]
    """Facts about its training."""

    @property
    def action_repeat(self) -> int:
        """Time steps of a decision, as it learned."""
        return int(self.env_arguments.get("action_repeat", 2))

    @property
    def needs_filter(self) -> bool:
        """True if it learned behind a filter, and never what a collision costs."""
        return bool(self.training.get("filter", False))

    def __post_init__(self) -> None:
        # A compiled loop writes as many numbers as the parts have.
        if self.action_size != 2:
            raise ValueError(f"action.size must be 2, a left and a right wheel: {self.action_size}")
        memory: Any = self.memory
        parts = observation_slices(self.sectors, memory=memory, history=self.history)
        if self.observation_size != (sensed := max(part.stop for part in parts.values())):
            raise ValueError(
                f"observation.size must be {sensed}, of {self.sectors} sectors, history "
                f"{self.history} and memory {self.memory!r}, got {self.observation_size}"
            )

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Card:
        """Read a card from the values of its JSON file.

        Raises:
            CardError: If something is missing, of another kind, or not as this version senses.
        """
        try:
            return cls._of(document)
        except KeyError as error:
            raise CardError(f"the card has no {error.args[0]!r}") from None
        except (TypeError, ValueError) as error:
            raise CardError(f"the card does not fit: {error}") from None

    @classmethod
    def _of(cls, document: Mapping[str, Any]) -> Card:
        if document["format"] != FORMAT:
            raise ValueError(f"format must be {FORMAT}, got {document['format']!r}")
        for name, value in SCALES.items():
            if document["scales"][name] != value:
                raise ValueError(f"scales.{name} must be {value}, got {document['scales'][name]!r}")
        return cls(
            **{
                field: read(entry, reduce(getitem, entry.split("."), document))
                for field, (entry, read) in _ENTRIES.items()
            }
        )


def card_file(path: str | os.PathLike[str]) -> Path:
    """Path of the card of an ONNX file, ``policy.json`` next to ``policy.onnx``."""
    return Path(path).with_suffix(".json")


def read_exported(path: str | os.PathLike[str]) -> tuple[Card, bytes]:
    """Read an exported policy and its card; nothing in either is executed.

    Args:
        path: The ONNX file; the card lies next to it.

    Returns:
        The card and the content of the ONNX file.

    Raises:
        FileNotFoundError: If one of the two is missing.
        CardError: If the card is no card, or of another file.
    """
    file, beside = Path(path), card_file(path)
    content, text = (
        _read(file, "policy", _LARGEST),
        _read(beside, "card of the policy", _LARGEST_CARD),
    )
    try:
        document = json.loads(text)
        wanted = document["sha256"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise CardError(f"{beside} is no card of a policy: {error!r}") from None
    if (found := hashlib.sha256(content).hexdigest()) != wanted:
        raise CardError(f"{beside} is the card of another file than {file}: sha256 {found}")
    try:
        return Card.of(document), content
    except CardError as error:
        raise CardError(f"{beside}: {error}") from None


def _read(path: Path, what: str, most: int) -> bytes:
    """Read one of the two files of an exported policy."""
    try:
        return read_file(path, most)
    except FileNotFoundError:
        remedy = "export_policy, or the script export.py, writes both files"
        raise FileNotFoundError(f"there is no {what} at {path}: {remedy}") from None
    except OSError as error:
        raise CardError(f"{path} is no {what}: {error}") from error


def check_finite(name: str, values: Any, size: int) -> tuple[float, ...]:
    """Read a number of finite numbers."""
    found = tuple(check_number(name, value) for value in values)
    if len(found) != size:
        raise ValueError(f"{name} must be {size} numbers, got {len(found)}")
    return found


class Network:
    """A function from observations to actions.

    Args:
        content: Content of an ONNX file with one input ``[N, O]`` and one output ``[N, A]``.
        observation_size: O.
        action_size: A.

    Raises:
        CardError: If the content is no such network, or its weights lie in another file, which a
            card says nothing of and which is looked for in the working folder.
        ImportError: If there is no onnxruntime.
    """

    def __init__(self, content: bytes, observation_size: int, action_size: int) -> None:
        # The key that every tensor in another file has, found anywhere in the content.
        if b"location" in content:
            raise CardError("the network must hold its weights, and this one names another file")
        try:
            import onnxruntime
        except ImportError as error:
            needs = f"an exported policy needs onnxruntime ({error})"
            raise ImportError(
                f"{needs}: install the extra 'onnx', see Install in the README"
            ) from error
        options = onnxruntime.SessionOptions()
        # For so small a network threads wait longer for each other than they compute.
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(
                content, options, providers=["CPUExecutionProvider"]
            )
        # The runtime's errors have no base class of their own.
        except Exception as error:
            cause = cause_of(error)
            raise CardError(f"the file holds no network that onnxruntime runs: {cause}") from error
        ends = [
            [(end.type, *end.shape[1:]) for end in ends]
            for ends in (self._session.get_inputs(), self._session.get_outputs())
        ]
        wanted = [[("tensor(float)", observation_size)], [("tensor(float)", action_size)]]
        if ends != wanted:
            raise CardError(f"the network must map {wanted[0]} to {wanted[1]}, got {ends}")
        self._input = self._session.get_inputs()[0].name

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Choose actions.

        Args:
            observations: Shape ``[N, O]``.

        Returns:
            Actions, ``[N, A]``. Those of a quantized network depend on the other rows.
        """
        found: NDArray[np.float32] = self._session.run(None, {self._input: observations})[0]
        return found
