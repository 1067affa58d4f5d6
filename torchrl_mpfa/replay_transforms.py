"""A warning of a transform that makes wrong targets without raising an error."""

from __future__ import annotations

import warnings
from typing import Any

from torch import nn
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs.transforms import MultiStepTransform

from torchrl_mpfa.storages.schema import as_path


class TransformedReplayBuffer(TensorDictReplayBuffer):
    """TorchRL's buffer, which looks at each transform that it gets."""

    def _initialize_prioritized_sampler(self) -> None:
        # The last that is done when the parts are made.
        super()._initialize_prioritized_sampler()
        _warn_of_steps_past_the_end(self._transform)

    def append_transform(self, transform: Any, *, invert: bool = False) -> Any:
        """Add a transform at the end, as in TorchRL."""
        _warn_of_steps_past_the_end(transform)
        return super().append_transform(transform, invert=invert)

    def insert_transform(self, index: int, transform: Any, *, invert: bool = False) -> Any:
        """Add a transform at a place, as in TorchRL."""
        _warn_of_steps_past_the_end(transform)
        return super().insert_transform(index, transform, invert=invert)


def _warn_of_steps_past_the_end(transform: Any) -> None:
    """Warn of n-step transitions that do not know that their last step ended the episode."""
    for part in transform.modules() if isinstance(transform, nn.Module) else ():
        if not isinstance(part, MultiStepTransform) or part.n_steps == 1:
            continue
        if any(as_path(key)[-1] == "terminated" for key in part.done_keys):
            warnings.warn(
                f"MultiStepTransform with done_keys={part.done_keys} leaves 'terminated' where it "
                "was, while the next observation moves n steps on: targets are bootstrapped past "
                "the end of an episode. Set done_keys=['done']",
                stacklevel=4,
            )
