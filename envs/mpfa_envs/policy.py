"""Trained policies: a plain function of the observation, and a file that holds it."""

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

from mpfa_envs.files import check_replaceable, read_file, write_atomically
from mpfa_envs.layers import KINDS, Layer, arrays_of, check_layers, from_torch

if TYPE_CHECKING:
    from numpy.typing import NDArray

FILE_NAME: Final = "policy.npz"
"""What the file is called in the folder of a run."""
_FORMAT: Final = 1
_ABOUT: Final = "about"
"""The entry with all that is not a weight: JSON as bytes."""
_LARGEST: Final = 2**28
"""A file that unpacks to more than this is no policy [bytes]."""
_BLOCK: Final = 16


class PolicyFileError(ValueError):
    """A file does not hold a policy, or was damaged; the message names the file."""


class Policy:
    """A network that chooses actions, in NumPy alone.

    Args:
        layers: The layers in their order, see :mod:`mpfa_envs.layers`.
        card: Plain values that say what it is: how it was trained, what it can do.
        env_arguments: Arguments of :class:`~mpfa_envs.NavigationEnv` under which it senses and
            acts as it learned to: robot, physics, time limit, action repeat, closeness distance.

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
        self.env_arguments: dict[str, Any] = _plain("env_arguments", env_arguments or {})

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
            card: As in :class:`Policy`.
            env_arguments: As in :class:`Policy`.

        Returns:
            The policy. It does not change when the network learns on.

        Raises:
            ValueError: If a layer is of another kind, or as in :class:`Policy`.
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
        # Always as many rows at once: a matrix product of another height adds in another order.
        padding = -len(rows) % _BLOCK
        padded = np.pad(rows.astype(np.float64), ((0, padding), (0, 0)))
        blocks = padded.reshape(-1, _BLOCK, self.observation_size)
        actions = np.empty((len(blocks) * _BLOCK, self.action_size), dtype=np.float32)
        for number, block in enumerate(blocks):
            values: NDArray[np.float64] = block
            for layer in self.layers:
                values = layer(values)
            actions[number * _BLOCK : (number + 1) * _BLOCK] = values
        return actions[: len(rows)]

    def __repr__(self) -> str:
        kinds = ", ".join(type(layer).__name__ for layer in self.layers)
        return f"Policy({self.observation_size} -> {self.action_size}: {kinds})"


def save_policy(policy: Policy, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
    """Write a policy to a file, whole or not at all.

    Args:
        policy: The policy.
        path: The file; in a folder it is called ``policy.npz``. Another policy there is replaced.
        overwrite: Whether anything else there is replaced, too.

    Returns:
        The file.

    Raises:
        FileExistsError: If there is a file that holds no policy, and overwrite is false.
        ValueError: If it is out of an ONNX file, which holds no layers.

    Examples:
        >>> import tempfile
        >>> from mpfa_envs import Policy, load_policy, save_policy
        >>> from mpfa_envs.layers import Linear
        >>> policy = Policy([Linear(np.ones((2, 24), np.float32), np.zeros(2, np.float32))])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = save_policy(policy, folder)
        ...     load_policy(folder)
        Policy(24 -> 2: Linear)
    """
    if not policy.layers:
        raise ValueError(f"policy must have layers, got {policy!r}: copy its file and its card")
    file = _file(path)
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
        path: The file, or the folder of a run; or an ONNX file of :func:`~mpfa_envs.export_policy`
            with its card beside it, which needs onnxruntime.

    Returns:
        The policy.

    Raises:
        FileNotFoundError: If there is no such file.
        PolicyFileError: If it is no policy, was damaged, or is of another version.
    """
    file = _file(path)
    if file.suffix == ".onnx":
        from mpfa_envs.onnx_policy import OnnxPolicy

        return OnnxPolicy(file)
    return _load(file)


def _load(file: Path) -> Policy:
    """Read a policy that :func:`save_policy` wrote."""
    try:
        return _read(read_file(file, _LARGEST))
    except FileNotFoundError:
        raise FileNotFoundError(f"there is no policy at {file}") from None
    # A damaged archive fails in many ways: a wrong checksum, header, length, number, password.
    except Exception as error:
        raise PolicyFileError(f"{file} holds no policy, or is damaged: {error}") from error


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
    return Policy(layers, card=about["card"], env_arguments=about["env_arguments"])


def _file(path: str | os.PathLike[str]) -> Path:
    path = Path(path)
    return path / FILE_NAME if path.is_dir() else path


def _plain(name: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of plain values, as JSON gives it back."""
    try:
        text = json.dumps(dict(values), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must hold plain values of JSON: {error}") from error
    plain: dict[str, Any] = json.loads(text)
    return plain
