"""Writes to entries of transitions that are stored already, which their signals follow."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from torchrl.data import TensorDictReplayBuffer

from torchrl_mpfa.replay_transforms import TransformedReplayBuffer
from torchrl_mpfa.storages.base import SignalStorageMixin


def _followed(write: Callable[..., Any]) -> Callable[..., Any]:
    """A write in place, after which the storage reads its signals anew."""

    @wraps(write)
    def followed(self: TensorDictReplayBuffer, *args: Any, **kwargs: Any) -> Any:
        if not isinstance(self.storage, SignalStorageMixin):
            return write(self, *args, **kwargs)
        with self._replay_lock, self.storage.rewriting():
            return write(self, *args, **kwargs)

    return followed


class FollowedReplayBuffer(TransformedReplayBuffer):
    """TorchRL's buffer with signals in its storage that follow every write in place."""

    set_ = _followed(TensorDictReplayBuffer.set_)
    set_at_ = _followed(TensorDictReplayBuffer.set_at_)
    update_ = _followed(TensorDictReplayBuffer.update_)
    update_if_present = _followed(TensorDictReplayBuffer.update_if_present)
    _set_places = _followed(TensorDictReplayBuffer.__setitem__)

    def __setitem__(self, index: Any, value: Any) -> None:
        """Write transitions, or by a key one entry of all of them, in place.

        With a key TorchRL writes to a copy where the storage is not full, and where it is puts the
        value itself in the storage.
        """
        if not isinstance(self.storage, SignalStorageMixin) or not isinstance(index, str | tuple):
            super().__setitem__(index, value)
        elif isinstance(index, str) or all(isinstance(word, str) for word in index):
            self.set_(index, self._transpose(value) if self.dim_extend > 0 else value)
        else:
            self._set_places(index, value)
