"""The network of an exported policy under onnxruntime."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mpfa_envs.deploy.card import CardError
from mpfa_envs.files import cause_of

if TYPE_CHECKING:
    from numpy.typing import NDArray


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
