"""What a learner refuses before it changes: batches that spoil networks, and foreign states."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NoReturn

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_mpfa.checks import NOT_NEGATIVE, check, check_finite


def refuse_unfinished(losses: Mapping[str, Tensor], batch: TensorDictBase) -> None:
    """Refuse an update of which a loss is not finite.

    One NaN in an observation would make all weights NaN. Losses are looked at and not the batch,
    as that is one number for each.

    Args:
        losses: Values for the log, of which those whose name begins with ``"loss"`` are asked.
        batch: What they were computed of.

    Raises:
        ValueError: If one is not finite, with the entry and the row that are the cause.
    """
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
    except torch.OutOfMemoryError:
        raise
    except RuntimeError as error:
        found = [(k, v) for k, v in batch.items(True, True) if isinstance(v, Tensor)]
        forms = ", ".join(f"{key!r} {[*value.shape]} {value.dtype}" for key, value in found)
        raise RuntimeError(f"batch does not fit the loss, got {forms}: {error}") from error


def refuse_copy(learner: object) -> NoReturn:
    """Refuse to copy a learner: the optimizer of a copy would move none of the copy's parameters.

    TorchRL's losses hold parameters in ways that a deep copy takes apart.

    Raises:
        TypeError: Always.
    """
    raise TypeError(
        f"a {type(learner).__name__} cannot be copied: make another one, and have it load the "
        "state_dict() of this one"
    )


def check_state(given: Any, own: Mapping[str, Any], optimizer: torch.optim.Optimizer) -> None:
    """Refuse what is not the state of such a learner.

    Args:
        given: What is to be loaded.
        own: The learner's own state.
        optimizer: Its optimizer.

    Raises:
        ValueError: If an entry is missing, unknown, of another shape or type, or not finite.
    """
    _check_keys("state_dict", given, own)
    _check_keys("state_dict['loss']", given["loss"], own["loss"])
    for name, value in own["loss"].items():
        _check_entry(f"state_dict['loss'][{name!r}]", given["loss"][name], value)
    check_updates(given["updates"])
    _check_optimizer(given["optimizer"], own["optimizer"], optimizer)
    if given["updates"] and not given["optimizer"]["state"]:
        raise ValueError(
            f"state_dict['optimizer']['state'] must not be empty after {given['updates']} updates"
        )


def check_updates(updates: Any) -> None:
    """Refuse what is no number of updates.

    Raises:
        ValueError: If it is not an integer, or negative.
    """
    if isinstance(updates, bool) or not isinstance(updates, int) or updates < 0:
        raise ValueError(f"state_dict['updates'] must be a count, got {updates!r}")


def _check_keys(name: str, given: Any, own: Mapping[Any, Any]) -> None:
    if not isinstance(given, Mapping):
        raise ValueError(f"{name} must be a mapping, got {type(given).__name__}")
    for word, keys in (("lacks", own.keys() - given.keys()), ("has", given.keys() - own.keys())):
        if keys:
            first = min(map(str, keys))
            raise ValueError(f"{name} {word} {first!r}, unlike that of this learner")


def _check_entry(name: str, given: Any, own: Any) -> None:
    """Refuse a tensor of another shape or with numbers that are not finite."""
    if not isinstance(own, Tensor):
        if type(given) is not type(own):
            raise ValueError(f"{name} must be a {type(own).__name__}, got {type(given).__name__}")
        return
    if not isinstance(given, Tensor):
        raise ValueError(f"{name} must be a tensor, got {type(given).__name__}")
    if given.shape != own.shape:
        raise ValueError(f"{name} must have shape {tuple(own.shape)}, got {tuple(given.shape)}")
    if given.is_floating_point() != own.is_floating_point():
        raise ValueError(f"{name} must be of {own.dtype}, got {given.dtype}")
    if not bool(given.isfinite().all()):
        raise ValueError(f"{name} must be finite, got {given[~given.isfinite()][0].item()}")


def _check_optimizer(given: Any, own: Mapping[str, Any], optimizer: torch.optim.Optimizer) -> None:
    """Refuse the state of another optimizer, or of one for other parameters."""
    name = "state_dict['optimizer']"
    _check_keys(name, given, own)
    groups, mine = given["param_groups"], own["param_groups"]
    if not isinstance(groups, list) or len(groups) != len(mine):
        raise ValueError(f"{name}['param_groups'] must have {len(mine)} groups, got {groups!r}")
    for place, (group, expected) in enumerate(zip(groups, mine, strict=True)):
        _check_keys(f"{name}['param_groups'][{place}]", group, expected)
        for key in ("lr", "eps", "weight_decay"):
            check(NOT_NEGATIVE, **{f"{name}['param_groups'][{place}][{key!r}]": group[key]})
        if group["params"] != expected["params"]:
            raise ValueError(
                f"{name}['param_groups'][{place}]['params'] must be {expected['params']}, got "
                f"{group['params']}"
            )
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    state = given["state"]
    if not isinstance(state, Mapping) or not set(state) <= set(range(len(parameters))):
        raise ValueError(f"{name}['state'] must be of {len(parameters)} parameters")
    for place, values in state.items():
        _check_keys(f"{name}['state'][{place}]", values, dict.fromkeys(_MOMENTS))
        for key, value in values.items():
            like = torch.zeros(()) if key == "step" else parameters[place]
            _check_entry(f"{name}['state'][{place}][{key!r}]", value, like)
            if key != "exp_avg":
                check_finite(f"{name}['state'][{place}][{key!r}]", value)


_MOMENTS = ("step", "exp_avg", "exp_avg_sq")
"""What Adam and RAdam keep of a parameter."""
