"""A module that a loss can call with tensors."""

from __future__ import annotations

from collections.abc import Mapping

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn


class DirectModule(TensorDictModule):
    """A :class:`~tensordict.nn.TensorDictModule` that is a plain function of its inputs as well.

    A loss that calls a network through tensordicts spends half as much time on them as on the
    network, if that is small. The losses of this package call these modules directly; any other
    module works there, too, but slower.

    Args:
        module: Function of one tensor per key of ``in_keys``, in their order.
        in_keys: What it reads.
        out_keys: What it gives.

    Examples:
        >>> import torch
        >>> double = DirectModule(lambda x: 2 * x, in_keys=["x"], out_keys=["y"])
        >>> double.outputs({"x": torch.ones(2)})["y"]
        tensor([2., 2.])
    """

    def __init__(
        self, module: nn.Module, in_keys: list[NestedKey], out_keys: list[NestedKey]
    ) -> None:
        super().__init__(module, in_keys=in_keys, out_keys=out_keys)

    def outputs(
        self, inputs: Mapping[NestedKey, Tensor] | TensorDictBase
    ) -> dict[NestedKey, Tensor]:
        """Compute the outputs and leave the inputs as they are.

        Args:
            inputs: Tensors by key, in a mapping or a tensordict.

        Returns:
            Outputs by key.
        """
        return self.by_key(self.module(*[inputs.get(key) for key in self.in_keys]))

    def by_key(self, found: Tensor | tuple[Tensor, ...]) -> dict[NestedKey, Tensor]:
        """Name what the module gave."""
        return dict(
            zip(self.out_keys, found if isinstance(found, tuple) else (found,), strict=True)
        )
