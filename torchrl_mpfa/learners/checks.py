"""Checks of a learner's batches, losses and saved states: what is wrong, and where."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_mpfa.saving import check_saved_numbers


@contextmanager
def fits_loss(batch: TensorDictBase) -> Iterator[None]:
    """Say of which form a batch is that does not fit the loss."""
    try:
        yield
    except RuntimeError as error:
        if type(error) is not RuntimeError:  # Memory or compiler failed, whatever the batch.
            raise
        found = [(k, v) for k, v in batch.items(True, True) if isinstance(v, Tensor)]
        forms = ", ".join(f"{key!r} {[*value.shape]} {value.dtype}" for key, value in found)
        raise RuntimeError(f"batch does not fit the loss, got {forms}: {error}") from error


def check_losses(losses: Mapping[str, Tensor], batch: TensorDictBase) -> None:
    """Raise if a value whose name begins with ``"loss"`` is not finite, with entry and row."""
    # One NaN in an observation would make all weights NaN. Losses are looked at and not the batch,
    # as that is one number for each.
    for name, value in losses.items():
        if not name.startswith("loss"):
            continue
        if math.isfinite(value.item()) if value.ndim == 0 else bool(value.isfinite().all()):
            continue
        cause = _first_not_finite(batch)
        if cause is not None:
            raise ValueError(f"batch must be finite, got {cause}")
        raise ValueError(
            f"{name} must be finite, got {value.sum().item()} of a finite batch: lower the "
            "learning rate, or scale the rewards"
        )


def _first_not_finite(batch: TensorDictBase) -> str | None:
    """Describe the first number of a batch that is not finite, but for the signals."""
    for key, value in batch.items(True, True):
        written = key[0] if isinstance(key, tuple) else key
        if written in {"signals", "td_error"} or not torch.is_floating_point(value):
            continue
        rows = (~value.isfinite()).reshape(len(value), -1)
        if bool(rows.any()):
            row = int(rows.any(1).nonzero()[0])
            number = value[row].reshape(-1)[rows[row]][0].item()
            return f"{number} in {key!r}, row {row}"
    return None


def check_alike(part: str, state: Any, own: Any) -> None:
    """Raise unless a saved state has the entries, types and sizes of a part's own, all finite."""
    _check_form(f"the saved {part}", state, own)
    check_saved_numbers(part, state)


def _check_form(place: str, state: Any, own: Any) -> None:
    if isinstance(own, Tensor) and isinstance(state, Tensor):
        # PyTorch keeps a count in the default type of the process that began.
        if state.shape != own.shape or (state.dtype is not own.dtype and own.ndim):
            raise ValueError(f"{place} must be {_form(own)}, got {_form(state)}")
    elif isinstance(own, Mapping) and isinstance(state, Mapping):
        # The moments of an optimizer come with the first gradient of a parameter.
        missing = [] if place.endswith("'state'") else [key for key in own if key not in state]
        if unfit := [*missing, *(key for key in state if key not in own)]:
            word = "lacks" if missing else "must not have"
            raise ValueError(f"{place} {word} {unfit[0]!r}")
        for key, value in state.items():
            _check_form(f"{place}, {key!r}", value, own[key])
    elif isinstance(own, list) and isinstance(state, list) and len(own) == len(state):
        for number, pair in enumerate(zip(state, own, strict=True)):
            _check_form(f"{place}, {number}", *pair)
    elif type(state) is not type(own) or isinstance(own, list):
        raise ValueError(f"{place} must be {_form(own)}, got {_form(state)}")


def _form(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"{value.dtype} of shape {[*value.shape]}"
    if isinstance(value, Mapping):
        return "a mapping"
    return f"a list of {len(value)}" if isinstance(value, list) else repr(value)
