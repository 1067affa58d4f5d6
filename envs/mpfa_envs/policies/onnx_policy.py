"""A policy that an ONNX file holds, where one out of a training run is taken as well."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mpfa_envs.deploy.card import CardError, read_exported
from mpfa_envs.deploy.network import Network
from mpfa_envs.policies.policy import Policy, PolicyFileError

if TYPE_CHECKING:
    import os

    from numpy.typing import NDArray


class OnnxPolicy(Policy):
    """An exported policy with its card beside it; onnxruntime computes it."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        try:
            card, content = read_exported(path)
            self._network = Network(content, card.observation_size, card.action_size)
        except CardError as error:
            raise PolicyFileError(str(error)) from error
        self.observation_size, self.action_size = card.observation_size, card.action_size
        self.layers = ()
        self.card: dict[str, Any] = dict(card.training)
        self.env_arguments: dict[str, Any] = dict(card.env_arguments)

    def _choose(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        # One at a time: a quantized network finds its scales in all rows that it is given.
        actions = [self._network(row[None]) for row in rows]
        return np.concatenate(actions or [np.empty((0, self.action_size), np.float32)])

    def __repr__(self) -> str:
        return f"OnnxPolicy({self.observation_size} -> {self.action_size})"
