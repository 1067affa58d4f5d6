"""Batches that would spoil networks, and states of other learners: rejected before a change."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_mpfa.saved import Entry, check_entries, count, exactly, number


def refuse_unfinished(losses: Mapping[str, Tensor], batch: TensorDictBase) -> None:
    """Raise if a value whose name begins with ``"loss"`` is not finite, with entry and row."""
    # One NaN in an observation would make all weights NaN. Losses are looked at and not the batch,
    # as that is one number for each.
    wrong = {
        name: value
        for name, value in losses.items()
        if name.startswith("loss") and not _finite(value)
    }
    if not wrong:
        return
    name, value = next(iter(wrong.items()))
    cause = _first_not_finite(batch)
    if cause is not None:
        raise ValueError(f"batch must be finite, got {cause}")
    raise ValueError(f"{name} must be finite, got {value.sum().item()} of a finite batch")


def _finite(value: Tensor) -> bool:
    if value.ndim == 0:
        return math.isfinite(value.item())
    return bool(value.isfinite().all())


def _first_not_finite(batch: TensorDictBase) -> str | None:
    """The first number of a batch that is not finite, in words; signals were just written."""
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


@contextmanager
def naming(batch: TensorDictBase) -> Iterator[None]:
    """Say of which batch an error of PyTorch is, such as that two matrices do not fit."""
    try:
        yield
    except RuntimeError as error:
        if type(error) is not RuntimeError:  # Memory or compiler failed, whatever the batch.
            raise
        found = [(k, v) for k, v in batch.items(True, True) if isinstance(v, Tensor)]
        forms = ", ".join(f"{key!r} {[*value.shape]} {value.dtype}" for key, value in found)
        raise RuntimeError(f"batch does not fit the loss, got {forms}: {error}") from error


def check_state(state: Any, own: Mapping[str, Any], optimizer: torch.optim.Optimizer) -> None:
    """Reject what is not the state of a learner whose own state is this, before it is loaded.

    Raises:
        ValueError: If an entry is missing, unknown, of another shape or type, or not finite.
    """
    _check("learner", state, [Entry("loss"), Entry("optimizer"), count("updates")])
    _check("loss", state["loss"], [_alike(*pair) for pair in own["loss"].items()])
    groups = own["optimizer"]["param_groups"]
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    known = set(range(len(parameters)))

    def of_known(found: Any) -> bool:
        full = isinstance(found, Mapping) and set(found) <= known
        return full and bool(found or not state["updates"])

    words = f"of {len(parameters)} parameters, and not empty after {state['updates']} updates"
    of_optimizer = [
        Entry("state", of_known, words),
        Entry(
            "param_groups",
            lambda found: isinstance(found, list) and len(found) == len(groups),
            f"{len(groups)} groups",
        ),
    ]
    _check("optimizer", state["optimizer"], of_optimizer)
    for place, group in enumerate(groups):
        rates = [number(name) for name in ("lr", "eps", "weight_decay")]
        known_names = {*(rate.name for rate in rates), "params"}
        others = [Entry(name) for name in group if name not in known_names]
        entries = [*rates, exactly("params", group["params"]), *others]
        _check(f"optimizer's group {place}", state["optimizer"]["param_groups"][place], entries)
    for place, moments in state["optimizer"]["state"].items():
        mean = _alike("exp_avg", parameters[place])
        square = replace(mean, name="exp_avg_sq", holds=_not_negative, wanted=_NOT_NEGATIVE)
        # PyTorch keeps it in the default type of the process that began.
        step = Entry("step", _is_step, "a tensor of one number, finite and not negative")
        _check(f"moments of parameter {place}", moments, [step, mean, square])


_NOT_NEGATIVE = "finite and not negative"


def _is_step(found: Any) -> bool:
    single = isinstance(found, Tensor) and found.ndim == 0 and found.is_floating_point()
    return single and bool(_not_negative(found))


def _not_negative(found: Tensor) -> Tensor:
    return found.isfinite() & (found >= 0)


def _alike(name: str, own: Any) -> Entry:
    """An entry with the form of what a learner has there."""
    if isinstance(own, Tensor):
        return Entry(name, torch.isfinite, "finite", own.dtype, tuple(own.shape))
    kind = type(own)
    return Entry(name, lambda found: type(found) is kind, f"a {kind.__name__}")


def _check(part: str, state: Any, entries: list[Entry]) -> None:
    """Reject a part of a state as :func:`check_entries` does, and one that has more entries."""
    check_entries(part, state, entries, missing=ValueError)
    unknown = set(state) - {each.name for each in entries}
    if unknown:
        raise ValueError(
            f"the saved {part} has {min(map(str, unknown))!r}, unlike that of this learner"
        )
