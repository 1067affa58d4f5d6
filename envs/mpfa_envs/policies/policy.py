"""Trained policies, which are plain functions of the observation, and their files.

They are written as npz and read as npz or ONNX, without executing anything in them.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mpfa_envs.deploy.card import CardError, Network, read_exported
from mpfa_envs.files import cause_of, check_replaceable, read_file, write_atomically
from mpfa_envs.policies.layers import KINDS, Layer, arrays_of, check_layers, from_torch
from mpfa_envs.robots.resolve import resolve_robot
from mpfa_envs.sensing.sensors import describe_sensors, resolve_sensors

if TYPE_CHECKING:
    from numpy.typing import NDArray

_BLOCK: Final = 16


class PolicyFileError(ValueError):
    """A file does not hold a policy, or was damaged; the message names the file."""


class Policy:
    """A network that chooses actions, in NumPy alone.

    Args:
        layers: The layers in their order (:mod:`mpfa_envs.policies.layers`).
        card: Plain values that say what it is: how it was trained, what it can do.
        env_arguments: Arguments of :class:`~mpfa_envs.NavigationEnv` under which it senses and
            acts as it learned to: robot, physics, time limit, action repeat, closeness distance.
            The robot and further sensors, however they are given, are kept as their values.

    Raises:
        ValueError: If the layers do not fit together, a weight is not finite, or the card or the
            arguments are no plain values.

    Examples:
        >>> import torch
        >>> from mpfa_envs import Policy
        >>> layers = [torch.nn.Linear(24, 64), torch.nn.ReLU(), torch.nn.Linear(64, 2)]
        >>> policy = Policy.from_layers([*layers, torch.nn.Tanh()], card={"method": "none"})
        >>> policy(np.zeros((5, 24), np.float32)).shape
        (5, 2)
    """

    def __init__(
        self,
        layers: Sequence[Layer],
        *,
        card: Mapping[str, Any] | None = None,
        env_arguments: Mapping[str, Any] | None = None,
    ) -> None:
        self.observation_size, self.action_size = check_layers(layers)
        self.layers = tuple(layers)
        self.card: dict[str, Any] = _plain("card", card or {})
        arguments = dict(env_arguments or {})
        if "robot" in arguments:
            # Its fields, so that a policy does not depend on a file, or on what a name stands for.
            arguments["robot"] = asdict(resolve_robot(arguments["robot"]))
        if "sensors" in arguments and not _are_described(arguments["sensors"]):
            arguments["sensors"] = describe_sensors(resolve_sensors(arguments["sensors"])) or {}
        self.env_arguments: dict[str, Any] = _plain("env_arguments", arguments)

    @classmethod
    def from_layers(
        cls,
        layers: Iterable[Any],
        *,
        card: Mapping[str, Any] | None = None,
        env_arguments: Mapping[str, Any] | None = None,
    ) -> Policy:
        """Copy the layers of a PyTorch network, from observation to action.

        Args:
            layers: ``Linear``, ``LayerNorm``, ``ReLU`` and ``Tanh``, and at the end what maps to
                the bounds of actions, where those are not [-1, 1].
            card: Of the policy.
            env_arguments: Of the policy.

        Returns:
            The policy. It does not change when the network learns on.

        Raises:
            ValueError: If a layer is of another kind, or the card or the arguments are no plain
                values.
        """
        return cls(from_torch(layers), card=card, env_arguments=env_arguments)

    def __call__(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Choose actions.

        Args:
            observation: Observations, shape ``[..., O]``.

        Returns:
            Actions, shape ``[..., A]``, float32, computed in double precision, so that another
            machine gives the same. Each depends on its own observation alone, to the last bit.

        Raises:
            ValueError: If the observations have another size.
        """
        observation = np.asarray(observation, dtype=np.float32)
        if observation.ndim == 0 or observation.shape[-1] != self.observation_size:
            raise ValueError(
                f"observation must have shape [..., {self.observation_size}], "
                f"got {observation.shape}"
            )
        actions = self._choose(observation.reshape(-1, self.observation_size))
        return actions.reshape(*observation.shape[:-1], self.action_size)

    def _choose(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """From ``[N, O]`` to ``[N, A]``."""
        # Always the same number of rows in a block: products of other heights add in another order.
        blocks = np.zeros((-(-len(rows) // _BLOCK), _BLOCK, self.observation_size))
        blocks.reshape(-1, self.observation_size)[: len(rows)] = rows
        for layer in self.layers:
            blocks = layer(blocks)
        actions = blocks.reshape(-1, self.action_size).astype(np.float32)
        return actions[: len(rows)]

    def __repr__(self) -> str:
        kinds = ", ".join(type(layer).__name__ for layer in self.layers)
        return f"Policy({self.observation_size} -> {self.action_size}: {kinds})"


def _are_described(sensors: Any) -> bool:
    """Return True if sensors are given as their values, as in a file."""
    return isinstance(sensors, Mapping) and all(isinstance(e, Mapping) for e in sensors.values())


def _plain(name: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of plain values, as JSON gives it back."""
    try:
        text = json.dumps(dict(values), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must hold plain values of JSON: {error}") from error
    plain: dict[str, Any] = json.loads(text)
    return plain


FILE_NAME: Final = "policy.npz"
"""Name of the file in the folder of a run."""
_SHIPPED: Final = Path(__file__).parents[1] / "data" / "policies"
POLICIES: Final = tuple(sorted(file.stem for file in _SHIPPED.glob("*.npz")))
"""Names of the trained policies that come with the package."""
_FORMAT: Final = 1
_ABOUT: Final = "about"
"""The entry with everything but the weights: JSON as bytes."""
_LARGEST: Final = 2**28
"""A file that unpacks to more than this is no policy [bytes]."""


def save_policy(policy: Policy, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
    """Write a policy to a file, whole or not at all.

    Args:
        policy: The policy.
        path: The file; in a folder it is called ``policy.npz``. Another policy there is replaced.
        overwrite: If True, replace any other file, too.

    Returns:
        The file.

    Raises:
        FileExistsError: If there is a file that holds no policy, and overwrite is false.
        ValueError: If it is out of an ONNX file, which holds no layers.

    Examples:
        >>> import tempfile
        >>> from mpfa_envs import Policy, load_policy, save_policy
        >>> from mpfa_envs.policies.layers import Linear
        >>> policy = Policy([Linear(np.ones((2, 24), np.float32), np.zeros(2, np.float32))])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = save_policy(policy, folder)
        ...     load_policy(folder)
        Policy(24 -> 2: Linear)
    """
    if not policy.layers:
        raise ValueError(f"policy must have layers, got {policy!r}: copy its file and its card")
    file = _inside(path)
    plain = [
        {
            "kind": type(layer).__name__,
            **{k: v for k, v in asdict(layer).items() if not isinstance(v, np.ndarray)},
        }
        for layer in policy.layers
    ]
    about = {
        "format": _FORMAT,
        "layers": plain,
        "card": policy.card,
        "env_arguments": policy.env_arguments,
    }
    arrays = {
        f"{number}.{name}": value
        for number, layer in enumerate(policy.layers)
        for name, value in arrays_of(layer).items()
    }
    packed = io.BytesIO()
    text = json.dumps(about, indent=1).encode()
    np.savez(packed, allow_pickle=False, **{_ABOUT: np.frombuffer(text, np.uint8)}, **arrays)
    check_replaceable(file, _load, "policy", overwrite=overwrite)
    write_atomically(packed.getvalue(), file)
    return file


def load_policy(path: str | os.PathLike[str]) -> Policy:
    """Read a policy without executing anything in the file.

    Args:
        path: The file, or the folder of a run; an ONNX file of :func:`~mpfa_envs.export_policy`
            with its card next to it, which needs onnxruntime; or a name in
            :data:`~mpfa_envs.POLICIES`.

    Returns:
        The policy.

    Raises:
        FileNotFoundError: If there is no such file.
        PolicyFileError: If it is no policy, was damaged, or is of another version.

    Examples:
        >>> from mpfa_envs import load_policy
        >>> load_policy("td3-rooms").env_arguments["memory"]
        'map'
    """
    file = policy_file(path)
    if file.suffix == ".onnx":
        return OnnxPolicy(file)
    return _load(file)


def _load(file: Path) -> Policy:
    """Read a policy that :func:`save_policy` wrote."""
    try:
        return _read(read_file(file, _LARGEST))
    except FileNotFoundError:
        names = ", ".join(POLICIES)
        message = f"there is no policy at {file}, and those that come with the package are {names}"
        raise FileNotFoundError(message) from None
    # A damaged archive raises many errors: a wrong checksum, header, length, number, password.
    except Exception as error:
        cause = cause_of(error)
        raise PolicyFileError(f"{file} holds no policy, or is damaged: {cause}") from error


def _read(content: bytes) -> Policy:
    """Read a policy from the bytes of its file."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
        if size > _LARGEST:
            raise ValueError(f"it unpacks to {size} bytes")
        # The checksums, once over everything: arrays are read no further than their shape says.
        damaged = archive.testzip()
    if damaged is not None:
        raise ValueError(f"the checksum of {damaged!r} does not match")
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        about = json.loads(bytes(arrays[_ABOUT]).decode())
        if about["format"] != _FORMAT:
            raise ValueError(f"its format is {about['format']!r}, not {_FORMAT}")
        layers = []
        for number, entry in enumerate(about["layers"]):
            kind = KINDS[entry.pop("kind")]
            prefix = f"{number}."
            weights = {
                name.removeprefix(prefix): np.asarray(arrays[name], dtype=np.float32)
                for name in arrays.files
                if name.startswith(prefix)
            }
            layers.append(kind(**entry, **weights))
    return Policy(layers, card=about["card"], env_arguments=_for_any_task(about["env_arguments"]))


def _for_any_task(env_arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out the time limit, which files of the package's policies have: it is the task's."""
    return {name: value for name, value in env_arguments.items() if name != "max_steps"}


def policy_file(path: str | os.PathLike[str]) -> Path:
    """Find the file of a policy: itself, in the folder of a run, or in the package by its name."""
    shipped = str(path) in POLICIES and not Path(path).exists()
    return _SHIPPED / f"{path}.npz" if shipped else _inside(path)


def _inside(path: str | os.PathLike[str]) -> Path:
    path = Path(path)
    return path / FILE_NAME if path.is_dir() else path


class OnnxPolicy(Policy):
    """An exported policy with its card next to it; onnxruntime computes it."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        try:
            card, content = read_exported(path)
            self._network = Network(content, card.observation_size, card.action_size)
        except CardError as error:
            raise PolicyFileError(str(error)) from error
        self.observation_size, self.action_size = card.observation_size, card.action_size
        self.layers = ()
        self.card: dict[str, Any] = dict(card.training)
        self.env_arguments = _for_any_task(card.env_arguments)

    def _choose(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        # One at a time: a quantized network takes its scales from all rows of a call.
        actions = [self._network(row[None]) for row in rows]
        return np.concatenate(actions or [np.empty((0, self.action_size), np.float32)])

    def __repr__(self) -> str:
        return f"OnnxPolicy({self.observation_size} -> {self.action_size})"
