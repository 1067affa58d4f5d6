"""Episodes of steps: a step follows another if it begins with the observation that ended the other.

Numbers of episodes and trajectories begin again with every collector and process; observations do
not.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_mpfa.storages.entries import as_path

if TYPE_CHECKING:
    # The samplers import this module.
    from torchrl_mpfa.samplers.table import SignalTable

_NOT_OBSERVED = {"reward", "done", "terminated", "truncated"}
_STEPS = "steps_to_next_obs"


def follows(storage: Any, table: SignalTable, before: Tensor, after: Tensor) -> Tensor:
    """Mask of stored steps that can follow others, by their slots, shape ``[B]``.

    Without observations, steps that were written since a load follow none from before.
    """
    old, new = (
        table.written_at(slots.to(table.device)) < table.loaded for slots in (before, after)
    )
    same_in_all = None
    for begin, end in _seen(storage._storage):
        first, second = _rows(end, before, storage.ndim), _rows(begin, after, storage.ndim)
        same = ((first == second) | ((first != first) & (second != second))).all(1).cpu()
        same_in_all = same if same_in_all is None else same_in_all & same
    return (old == new).cpu() if same_in_all is None else same_in_all


def episodes_of(
    steps: TensorDictBase,
    places: Tensor,
    number: Tensor,
    last: Tensor,
    loaded: Tensor | None = None,
    *,
    ndim: int = 1,
) -> Tensor:
    """Number episodes that no two share by the position of their first step, shape ``[B]``.

    Places ``[B]`` are of the flattened ``ndim`` dimensions of the steps, in the order of writing.
    A ``number`` of an episode may come again, ``last`` marks the last step of an episode. Without
    observations no episode continues from a ``loaded`` step to another.

    Examples:
        >>> from tensordict import TensorDict
        >>> at = torch.tensor([[0.0], [5.0], [1.0], [6.0]])  # Two robots in turn.
        >>> steps = TensorDict({"observation": at, "next": {"observation": at + 1}}, [4])
        >>> none = torch.zeros(4, dtype=torch.bool)
        >>> episodes_of(steps, torch.arange(4), torch.zeros(4), none).tolist()
        [0, 1, 0, 1]
    """
    count, place = len(places), torch.arange(len(places), device="cpu")
    seen, label = [*_seen(steps)], number.double().view(torch.long).cpu()
    if loaded is not None and not seen:
        label = 2 * label + loaded
    ends, begins = label.clone(), label.clone()
    for weight, (begin, end) in enumerate(seen, 1):
        begins += weight * _hash(_rows(begin, places, ndim))
        ends += weight * _hash(_rows(end, places, ndim))
    key = torch.cat((begins, ends))
    # Of equal ones in their order, in which a step begins before it ends.
    order = torch.cat((2 * place, 2 * place + 1)).argsort()
    order = order[key[order].argsort(stable=True)]
    at = torch.arange(2 * count, device="cpu")
    open_end = (order >= count) & ~last.cpu().repeat(2)[order]
    latest = torch.where(open_end, at, -1).cummax(0).values.clamp_min(0)
    joined = open_end[latest] & (key[order[latest]] == key[order]) & (order < count)
    first = place.clone()
    first[order[joined]] = order[latest[joined]] - count
    while not torch.equal(first, further := first[first]):
        first = further
    return first


def _seen(steps: TensorDictBase) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield the entries that steps have at their beginning and at their end."""
    ends = steps.get("next", None)
    # What several steps make of one is not what the next one begins with.
    if not isinstance(ends, TensorDictBase) or steps.get(_STEPS, None) is not None:
        return
    for key, end in ends.items(True, True):
        begin = steps.get(key, None)
        observed = (
            isinstance(end, Tensor) and isinstance(begin, Tensor) and begin.shape == end.shape
        )
        if observed and as_path(key)[-1] not in _NOT_OBSERVED:
            yield begin, end


def _rows(entry: Tensor, places: Tensor, ndim: int) -> Tensor:
    """Return an entry of some steps, shape ``[B, M]``."""
    return entry.flatten(0, ndim - 1)[places.to(entry.device)].unsqueeze(-1).flatten(1)


def _hash(rows: Tensor) -> Tensor:
    """Return a number for each row, on the CPU, which differs for different rows, shape ``[B]``."""
    # Adding zero makes one zero of the two that there are.
    bits = (rows.nan_to_num(nan=1e30).double() + 0.0).view(torch.long)
    seeded = torch.Generator("cpu").manual_seed(0)
    factor = torch.randint(2**62, (rows.shape[1],), generator=seeded, device="cpu")
    mixed = (bits ^ (bits >> 29)) * (2 * factor + 1).to(bits.device)
    return (mixed ^ (mixed >> 32)).sum(1).cpu()
