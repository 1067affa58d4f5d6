"""Trained policies as ONNX files, with a card that has all that a robot needs."""

from __future__ import annotations

import hashlib
import json
import logging
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mpfa_envs.deploy.card import FORMAT, SCALES, Card, CardError, card_file
from mpfa_envs.env.config import TaskConfig
from mpfa_envs.files import write_atomically
from mpfa_envs.policies.layers import Choice, Clip, LayerNorm, Linear, ReLU, Scale, Tanh

if TYPE_CHECKING:
    import os

    from numpy.typing import NDArray

    from mpfa_envs.policies.layers import Layer
    from mpfa_envs.policies.policy import Policy

_OPSET: Final = 17
"""The first that has layer normalization."""
_IR_VERSION: Final = 8
_MEANINGS: Final = {
    "lidar": "closeness min(closeness_distance / range, 1) of each sector, left to right",
    "goal_direction": "cosine and sine of the goal's direction in the robot's frame",
    "goal_closeness": "min(goal_closeness_distance / d, 1) for the goal's distance d",
    "goal_distance": "d / distance",
    "linear_speed": "forward speed / linear_speed, within +- speed_bound",
    "angular_speed": "turning speed / angular_speed, left positive, within +- speed_bound",
    "way_direction": "cosine and sine of the path's direction on the map, in the robot's frame",
    "way_length": "length of the path / distance, at most way_bound",
    "lidar_history": "lidar of earlier decisions, the newest first; at the start the first one",
}
_FRAMES: Final = {
    "robot": "center of the wheels' axle, x ahead, y to the left, angles to the left [m, rad]",
    "pose_and_goal": "any fixed frame, the same for both: that of the odometry",
}


def export_policy(
    policy: Policy,
    path: str | os.PathLike[str],
    *,
    quantize: bool = False,
    results: Sequence[Mapping[str, Any]] = (),
) -> Path:
    """Write a policy as an ONNX file, and its card next to it.

    The file computes in double precision, as :class:`~mpfa_envs.Policy` does, and takes and gives
    single precision; or with ``quantize`` in eight bits, its scales found again in each call.

    Args:
        policy: The policy.
        path: The file, ``policy.onnx``; the card is ``policy.json`` then.
        quantize: If True, round the weights to eight bits.
        results: Plain values for the card: how well it drives.

    Returns:
        The file.

    Raises:
        CardError: If the policy does not sense what its ``env_arguments`` say, or has a table.
        ValueError: If the path does not end in ``.onnx``.

    Examples:
        >>> from mpfa_envs import Policy, export_policy, load_policy
        >>> from mpfa_envs.policies.layers import Linear
        >>> policy = Policy([Linear(np.ones((2, 24), np.float32), np.zeros(2, np.float32))])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = export_policy(policy, Path(folder) / "ones.onnx")
        ...     load_policy(file)(np.full(24, 0.25, np.float32))
        array([6., 6.], dtype=float32)
    """
    path = Path(path)
    if path.suffix != ".onnx":
        raise ValueError(f"path must end in .onnx, got {path}")
    document = describe(policy, results=results)
    content = onnx_content(policy.layers, policy.observation_size, quantize=quantize)
    document |= {
        "file": path.name,
        "sha256": hashlib.sha256(content).hexdigest(),
        "precision": "int8" if quantize else "double",
    }
    text = json.dumps(document, indent=2, allow_nan=False) + "\n"
    write_atomically(content, path)
    write_atomically(text.encode(), card_file(path))
    return path


def describe(policy: Policy, *, results: Sequence[Mapping[str, Any]] = ()) -> dict[str, Any]:
    """The card of a policy as plain values, without its file."""
    if further := policy.env_arguments.get("sensors"):
        raise CardError(f"a robot senses by its lidar alone, not by {', '.join(further)}")
    config = TaskConfig(**policy.env_arguments)
    lidar = config.make_lidar()
    robot = config.robot
    document = {
        "format": FORMAT,
        "observation": {
            "size": policy.observation_size,
            "parts": [
                {
                    "name": name,
                    "first": part.start,
                    "size": part.stop - part.start,
                    "meaning": _MEANINGS[name],
                }
                for name, part in config.observation_slices.items()
            ],
        },
        "lidar": {
            "sectors": lidar.sectors,
            "rays_per_sector": lidar.rays_per_sector,
            "reduction": lidar.reduction,
            "max_range": lidar.max_range,
            "noise": lidar.noise,
            "field_of_view": lidar.field_of_view,
        },
        "memory": config.memory,
        "history": config.history,
        "scales": {
            "closeness_distance": config.closeness_distance,
            "linear_speed": robot.max_wheel_speed,
            "angular_speed": robot.max_angular_speed,
            **SCALES,
        },
        "frames": _FRAMES,
        "robot": asdict(robot),
        "action": {
            "size": policy.action_size,
            "bounds": [-1.0, 1.0],
            "meaning": "left and right wheel, from min_wheel_speed at -1 to max_wheel_speed at 1",
        },
        "limits": {
            "period": config.action_time,
            "goal_radius": config.goal_radius,
            "time_limit": config.time_step * config.max_steps,
            "linear_speed": [robot.min_wheel_speed, robot.max_wheel_speed],
            "angular_speed": [-robot.max_angular_speed, robot.max_angular_speed],
        },
        "training": policy.card,
        "env_arguments": policy.env_arguments,
        "results": [dict(each) for each in results],
    }
    Card.of(document)
    return document


def onnx_content(layers: Sequence[Layer], observation_size: int, *, quantize: bool) -> bytes:
    """The bytes of an ONNX file with some layers, the same for the same layers."""
    try:
        import onnx
        from onnx import TensorProto, helper
    except ImportError as error:
        needs = f"the export of a policy needs onnx ({error})"
        raise ImportError(
            f"{needs}: install the extra 'onnx', see Install in the README"
        ) from error

    graph = _Graph(np.float32 if quantize else np.float64)
    graph.add("Cast", "observation", to=graph.kind)
    for layer in layers:
        graph.add_layer(layer)
    graph.add("Cast", graph.last, to=TensorProto.FLOAT)
    graph.nodes[-1].output[0] = "action"
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", size])
        for name, size in (("observation", observation_size), ("action", graph.size))
    ]
    model = helper.make_model(
        helper.make_graph(graph.nodes, "policy", ends[:1], ends[1:], graph.weights),
        opset_imports=[helper.make_opsetid("", _OPSET)],
        ir_version=_IR_VERSION,
        producer_name="mpfa_envs",
    )
    onnx.checker.check_model(model, full_check=True)
    content: bytes = _quantized(model) if quantize else model.SerializeToString(deterministic=True)
    return content


class _Graph:
    """A chain of nodes and their weights."""

    def __init__(self, precision: type[np.float32] | type[np.float64]) -> None:
        from onnx import TensorProto

        self.precision = precision
        self.kind = TensorProto.FLOAT if precision is np.float32 else TensorProto.DOUBLE
        self.nodes: list[Any] = []
        self.weights: list[Any] = []
        self.last = ""
        self.size = 0

    def add(self, operator: str, *inputs: str, **attributes: Any) -> None:
        """Add a node, whose output becomes :attr:`last`."""
        from onnx import helper

        self.last = f"{operator.lower()}{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, inputs, [self.last], **attributes))

    def weight(self, values: NDArray[Any]) -> str:
        """Add a weight, and return its name."""
        from onnx import numpy_helper

        name = f"weight{len(self.weights)}"
        values = np.ascontiguousarray(values, dtype=self.precision)
        self.weights.append(numpy_helper.from_array(values, name))
        return name

    def add_layer(self, layer: Layer) -> None:
        """Add the nodes of a layer."""
        if isinstance(layer, Linear):
            self.add("MatMul", self.last, self.weight(layer.weight.T))
            self.add("Add", self.last, self.weight(layer.bias))
            self.size = len(layer.bias)
        elif isinstance(layer, LayerNorm):
            weights = self.weight(layer.weight), self.weight(layer.bias)
            self.add("LayerNormalization", self.last, *weights, epsilon=layer.eps)
        elif isinstance(layer, ReLU | Tanh):
            self.add(type(layer).__name__.capitalize(), self.last)
        elif isinstance(layer, Scale):
            self.add("Mul", self.last, self.weight(layer.half))
            self.add("Add", self.last, self.weight(layer.center))
        elif isinstance(layer, Clip):
            # ONNX's own clips by one number, not by one of each action.
            self.add("Max", self.last, self.weight(layer.low))
            self.add("Min", self.last, self.weight(layer.high))
        elif isinstance(layer, Choice):
            self.add("ArgMax", self.last, axis=-1, keepdims=0)
            self.add("Gather", self.weight(layer.actions), self.last)
            self.size = layer.actions.shape[1]
        else:
            raise CardError(f"a {type(layer).__name__} is no network: it has no ONNX file")


def _quantized(model: Any) -> bytes:
    """A model whose matrices have eight bits, seven of them used, as a file's content."""
    from onnxruntime.quantization import QuantType, quantize_dynamic

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "quantized.onnx"
        # Its recommendations do not apply to these networks.
        logging.disable(logging.WARNING)
        try:
            # On processors without VNNI sums of two products of eight bits overflow sixteen.
            quantize_dynamic(model, file, weight_type=QuantType.QInt8, reduce_range=True)
        finally:
            logging.disable(logging.NOTSET)
        return file.read_bytes()
