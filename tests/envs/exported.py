"""Small exported policies for the tests of what runs them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mpfa_envs import Policy, export_policy
from mpfa_envs.deploy import Card
from mpfa_envs.policies.layers import LayerNorm, Linear, ReLU, Tanh
from mpfa_envs.robots.model import ROBOTS
from mpfa_envs.sensing.observation import observation_slices

SHIPPED = "td3-paper"
"""A policy without a map."""
ENV_ARGUMENTS = {"robot": "turtlebot2", "physics": "kinematic", "closeness_distance": 0.23}


def make_policy(size: int = 24, **env_arguments: Any) -> Policy:
    """A network of random weights."""
    rng = np.random.default_rng(1)

    def linear(inputs: int, outputs: int) -> Linear:
        weight, bias = rng.normal(size=(outputs, inputs)), rng.normal(size=outputs)
        return Linear((weight / inputs**0.5).astype(np.float32), bias.astype(np.float32))

    scale = rng.uniform(0.5, 2.0, 32).astype(np.float32)
    norm = LayerNorm(scale, rng.normal(size=32).astype(np.float32), 1e-5)
    layers = [linear(size, 32), norm, ReLU(), linear(32, 2), Tanh()]
    return Policy(layers, card={"seed": 3}, env_arguments={**ENV_ARGUMENTS, **env_arguments})


def exported(folder: Path, size: int = 24, **env_arguments: Any) -> Path:
    """A file of :func:`make_policy`, with its card."""
    return export_policy(make_policy(size, **env_arguments), folder / "policy.onnx")


def card(**changes: Any) -> Card:
    """The card of a policy for a TurtleBot2, without a file."""
    sensed = {"sectors": 18, "memory": "none", "history": 0} | changes
    parts = observation_slices(
        sensed["sectors"], memory=sensed["memory"], history=sensed["history"]
    )
    values: dict[str, Any] = {
        "observation_size": max(part.stop for part in parts.values()),
        "action_size": 2,
        "sectors": 18,
        "field_of_view": 180.0,
        "reduction": "min",
        "max_range": 10.0,
        "closeness_distance": 0.25,
        "memory": "none",
        "history": 0,
        "robot": ROBOTS["turtlebot2"],
        "period": 0.2,
        "goal_radius": 0.5,
        "env_arguments": {},
        "training": {},
    }
    return Card(**values | changes)
