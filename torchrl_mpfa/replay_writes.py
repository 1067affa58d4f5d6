"""TorchRL's buffer with signals that follow writes in place, and a warning of a wrong transform."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import wraps
from typing import Any

from tensordict import TensorDict
from torch import nn
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs.transforms import MultiStepTransform

from torchrl_mpfa.replay_queue import QueueReplayBuffer
from torchrl_mpfa.samplers.signal_sampler import SignalSampler
from torchrl_mpfa.storages.base import SignalStorageMixin
from torchrl_mpfa.storages.schema import as_path


def _followed(
    write: Callable[..., Any], told: Callable[..., tuple[Any, Any]], *, waits: bool = True
) -> Any:
    """A write in place, of certain entries in certain slots, that the signals follow."""

    @wraps(write)
    def followed(self: QueueReplayBuffer, *args: Any, **kwargs: Any) -> Any:
        if waits:
            self._wait_for_queue()
        if not isinstance(self.storage, SignalStorageMixin):
            return write(self, *args, **kwargs)
        with self._replay_lock, self.storage.rewriting(*told(*args, **kwargs)):
            written = write(self, *args, **kwargs)
        if isinstance(self.sampler, SignalSampler):
            self.sampler.reread(self.storage)
        return written

    return followed


def _chosen(data: Any, clone: bool = False, *, keys_to_update: Any = None) -> tuple[Any, Any]:
    chosen = data if keys_to_update is None else TensorDict(dict(data)).select(*keys_to_update)
    return chosen, slice(None)


_Buffer = TensorDictReplayBuffer


class FollowedReplayBuffer(QueueReplayBuffer):
    """TorchRL's buffer with signals in its storage that follow every write in place."""

    set_ = _followed(_Buffer.set_, lambda key, value: ({key: value}, slice(None)))
    set_at_ = _followed(_Buffer.set_at_, lambda key, value, index: ({key: value}, index))
    update_ = _followed(_Buffer.update_, _chosen)
    # TorchRL puts it in the order of the batches itself, and these may wait for it.
    update_if_present = _followed(
        _Buffer.update_if_present, lambda patch, **_: (patch, None), waits=False
    )
    _set_places = _followed(_Buffer.__setitem__, lambda index, value: (value, index))

    def __setitem__(self, index: Any, value: Any) -> None:
        """Write transitions, or by a key one entry of all of them, in place.

        With a key TorchRL writes to a copy where the storage is not full, and where it is puts the
        value itself in the storage.
        """
        if not isinstance(self.storage, SignalStorageMixin) or not isinstance(index, str | tuple):
            self._wait_for_queue()
            super().__setitem__(index, value)
        elif isinstance(index, str) or all(isinstance(word, str) for word in index):
            self.set_(index, self._transpose(value) if self.dim_extend > 0 else value)
        elif len(index) == 1:
            self[index[0]] = value
        else:
            self._set_places(index, value)

    def _initialize_prioritized_sampler(self) -> None:
        # The last that is done when the parts are made.
        super()._initialize_prioritized_sampler()
        _warn_of_steps_past_the_end(self._transform)

    def append_transform(self, transform: Any, *, invert: bool = False) -> Any:
        """Add a transform at the end, as in TorchRL."""
        _warn_of_steps_past_the_end(transform)
        with self._without_queue():
            return super().append_transform(transform, invert=invert)

    def insert_transform(self, index: int, transform: Any, *, invert: bool = False) -> Any:
        """Add a transform at a place, as in TorchRL."""
        _warn_of_steps_past_the_end(transform)
        with self._without_queue():
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
