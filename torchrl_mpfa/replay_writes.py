"""Writes to entries of transitions that are stored already, which their signals follow."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from tensordict import TensorDict
from torchrl.data import TensorDictReplayBuffer

from torchrl_mpfa.replay_transforms import TransformedReplayBuffer
from torchrl_mpfa.storages.base import SignalStorageMixin


def _followed(write: Callable[..., Any], told: Callable[..., tuple[Any, Any]]) -> Any:
    """A write in place, of certain entries in certain slots, that the signals follow."""

    @wraps(write)
    def followed(self: TensorDictReplayBuffer, *args: Any, **kwargs: Any) -> Any:
        if not isinstance(self.storage, SignalStorageMixin):
            return write(self, *args, **kwargs)
        with self._replay_lock, self.storage.rewriting(*told(*args, **kwargs)):
            return write(self, *args, **kwargs)

    return followed


def _chosen(data: Any, clone: bool = False, *, keys_to_update: Any = None) -> tuple[Any, Any]:
    chosen = data if keys_to_update is None else TensorDict(dict(data)).select(*keys_to_update)
    return chosen, slice(None)


_Buffer = TensorDictReplayBuffer


class FollowedReplayBuffer(TransformedReplayBuffer):
    """TorchRL's buffer with signals in its storage that follow every write in place."""

    set_ = _followed(_Buffer.set_, lambda key, value: ({key: value}, slice(None)))
    set_at_ = _followed(_Buffer.set_at_, lambda key, value, index: ({key: value}, index))
    update_ = _followed(_Buffer.update_, _chosen)
    update_if_present = _followed(_Buffer.update_if_present, lambda patch, **_: (patch, None))
    _set_places = _followed(_Buffer.__setitem__, lambda index, value: (value, index))

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
