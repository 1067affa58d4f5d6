"""Uniform sampling that knows the newest transition."""

from __future__ import annotations

from typing import Any

import torch

from torchrl_mpfa.samplers.states import SavedValues
from torchrl_mpfa.saved import Entry

_NEWEST = Entry(
    "_newest",
    lambda newest: (
        newest is None
        or (
            isinstance(newest, list)
            and len(newest) > 0
            and all(type(p) is int and p >= 0 for p in newest)
        )
    ),
    "None, or a place for each dimension",
)


class NewestSampler(SavedValues):
    """Uniform sampling that keeps and saves the newest slot."""

    FILE = "newest.json"
    ENTRIES = (_NEWEST,)

    def __init__(self) -> None:
        super().__init__()
        self.newest: list[int] | None = None
        """Its place along each dimension of the storage; None where none is known.

        A buffer that was filled before it got this sampler has no newest transition yet.
        """

    def add(self, index: Any) -> None:
        """Take note of the newest slot."""
        super().add(index)
        self._note(index)

    def extend(self, index: Any) -> None:
        """Take note of the newest slot, the last of those written."""
        super().extend(index)
        self._note(index)

    def _note(self, index: Any) -> None:
        places = torch.stack(index, -1) if isinstance(index, tuple) else torch.as_tensor(index)
        places = places.reshape(-1, places.shape[-1] if places.ndim > 1 else 1)
        # TorchRL's writers mark with -1 what was not stored.
        stored = places[(places >= 0).all(-1)]
        if len(stored):
            self.newest = stored[-1].tolist()

    def _empty(self) -> None:
        super()._empty()
        self.newest = None
