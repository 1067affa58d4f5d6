"""What the small parts of a saved buffer must be, checked before anything is loaded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor


def check_writer_state(state: Any, slots: int | None) -> None:
    """Refuse the state of a writer in a ring that points outside the storage.

    Args:
        state: The state.
        slots: Number of slots that the writer goes around; None if it is not known yet.

    Raises:
        KeyError: If the state has no cursor.
        ValueError: If it cannot be.
    """
    if not isinstance(state, Mapping) or "_cursor" not in state:
        raise KeyError("'_cursor' is missing in the saved writer")
    cursor, count = state["_cursor"], state.get("_write_count", 0)
    if type(cursor) is not int or cursor < 0 or (slots is not None and cursor >= slots):
        bound = "not negative" if slots is None else f"in [0, {slots})"
        raise ValueError(f"'_cursor' of the saved writer must be {bound}, got {cursor!r}")
    if type(count) is not int or count < 0:
        raise ValueError(f"'_write_count' of the saved writer must not be negative, got {count!r}")


def check_sampler_state(sampler: Any, state: Any) -> None:
    """Refuse the state of another sampler.

    Args:
        sampler: The sampler; one of TorchRL's own has no check, and would leave out what it lacks.
        state: The state.

    Raises:
        ValueError: If it is that of another.
    """
    if hasattr(sampler, "check_state"):
        sampler.check_state(state)
    elif isinstance(state, Mapping) and "_kind" in state:
        raise ValueError(
            f"the saved sampler is {state['_kind']!r}, this one a {type(sampler).__name__}"
        )


def check_batch_size(found: Any) -> None:
    """Refuse a batch size that is neither None nor a positive integer."""
    if found is not None and (type(found) is not int or found < 1):
        raise ValueError(f"'_batch_size' of the saved buffer must be positive, got {found!r}")


def check_generator_state(found: Any) -> None:
    """Refuse the state of a generator that no generator takes."""
    if found is None:
        return
    try:
        state, device = found
        if not isinstance(state, Tensor):
            raise TypeError(f"got {type(state).__name__}")
        torch.Generator(device=device).set_state(state)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(
            f"'_rng' of the saved buffer is not the state of a generator: {error}"
        ) from None
