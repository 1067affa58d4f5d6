"""Trained policies: a plain function of the observation."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mpfa_envs.policies.layers import Layer, check_layers, from_torch
from mpfa_envs.robots.resolve import resolve_robot

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
            The robot, however it is given, is kept as its fields.

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


def _plain(name: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of plain values, as JSON gives it back."""
    try:
        text = json.dumps(dict(values), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must hold plain values of JSON: {error}") from error
    plain: dict[str, Any] = json.loads(text)
    return plain
