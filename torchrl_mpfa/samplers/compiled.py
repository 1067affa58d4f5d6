"""Sampling and updating a batch by one compiled call each, for samplers as the paper's.

PyTorch does the same for everything else: other devices, adjustments and functions of signals, and
subclasses that change a step between signals and leaves.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from ctypes import addressof
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_mpfa.adjustment import PositiveBoost, PositiveDecay, above_mean, factors_by_place
from torchrl_mpfa.native import Fusion, Replay, address, is_plain, loops, opaque
from torchrl_mpfa.samplers.table import SignalTable
from torchrl_mpfa.samplers.trees import CompiledTree
from torchrl_mpfa.samplers.weighing import Weighing, weigh
from torchrl_mpfa.signals import REWARD
from torchrl_mpfa.storages.rows import WIDTH, match_rows
from torchrl_mpfa.storages.schema import INDEX_KEY, as_path

if TYPE_CHECKING:
    from torchrl_mpfa.samplers.fused import SignalSampler

_BOUNDS = {"floor": 1, "cap": 2, "none": 3}
_MARGIN = above_mean(torch.double)
_KINDS: Any = ((), (PositiveBoost,), (PositiveDecay,), (PositiveBoost, PositiveDecay))
_STEPS = (
    *("mark_update", "_record", "check_new", "_sampled", "_sample_slots", "_proportional"),
    *("_fused", "combined", "_checked", "_set", "_write", "_follow", "_leaf"),
    "_empty_table",
)
"""Steps that compiled loops know as they are in ``SignalSampler``."""


def is_compiled(sampler: SignalSampler, kind: type[SignalSampler]) -> bool:
    """Return True if compiled loops write, sample and update for a sampler of this kind."""
    own, of_class = vars(sampler), type(sampler)
    return (
        all(s not in own and getattr(of_class, s) is getattr(kind, s) for s in _STEPS)
        and type(sampler.table) is SignalTable
        and sampler.dtype is torch.float
        and isinstance(sampler._sum_tree, CompiledTree)
        and tuple(map(type, sampler.adjustments)) in _KINDS
        and all(signal.priority is None for signal in sampler.table.learned)
        and all(getattr(a, "position", "batch") == "batch" for a in sampler.adjustments)
    )


def _replay(sampler: SignalSampler) -> Replay:
    tree, rows = sampler._sum_tree, sampler.table.rows
    sizes = tree.size, tree.blocks, rows.shape[1]
    return Replay(address(tree.nodes, torch.double), address(rows, torch.double), *sizes)


@opaque
def sample_compiled(
    sampler: SignalSampler, size: int, shares: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return slots, weights and times of writing at shares of the total priority, each ``[B]``.

    A replay of each is counted.

    Raises:
        RuntimeError: If a priority is not positive.
    """
    slots = shares.new_empty(shares.shape, dtype=torch.long)
    weight, written = shares.new_empty(shares.shape, dtype=torch.float), torch.empty_like(shares)
    replay = _replay(sampler)
    wrong = loops().sample(
        addressof(replay),
        min(size, sampler.table.capacity),
        address(shares, torch.double),
        shares.numel(),
        sampler._beta,
        address(slots, torch.long),
        address(weight, torch.float),
        address(written, torch.double),
    )
    if wrong:
        sampler.check_positive(size)
    return slots, weight, written


@opaque
def update_compiled(
    sampler: SignalSampler,
    slots: Tensor,
    signals: Mapping[str, Tensor],
    written_at: Tensor | None,
    batches: int,
) -> tuple[Weighing, float, int] | None:
    """Set signals and priorities of batches; return weights, the highest priority and its slot.

    None, and nothing changes, for what PyTorch has to do, or find fault with.
    """
    table, count = sampler.table, slots.numel()
    if type(batches) is not int or batches < 1 or count % batches or not slots.is_cpu:
        return None
    values = []
    for signal in table.learned:
        value = signals.get(signal.name)
        if value is None or not _fits(value, torch.float, count):
            return None
        values.append(value.contiguous())
    if written_at is None:
        filled = table.size
    elif _fits(written_at, torch.double, count):
        filled, written_at = max(table.size, table.cleared), written_at.contiguous()
    else:
        return None
    slots, replay = slots.contiguous(), _replay(sampler)
    batch = address(slots, torch.long), count
    written = None if written_at is None else address(written_at, torch.double)
    if loops().stale(addressof(replay), min(filled, table.capacity), *batch, written):
        return None
    first = slots if batches == 1 else slots[: count // batches]
    weighing = weigh(sampler, first, sampler._weighing)  # Eqs. (15)-(20).
    level = weighing.mean_reward if sampler.positive_above == "mean" else sampler.positive_above
    bound, boost, decay = 0, 1.0, None
    for place, adjust in enumerate(sampler.adjustments):
        if isinstance(adjust, PositiveBoost):
            counted = weighing.counted[place] if weighing.counted else None
            bound, boost = _BOUNDS[adjust.bound], float(adjust.factor(counted))
        elif isinstance(adjust, PositiveDecay):
            decay = _decay(count // batches, adjust.sharpness)
    weights = weighing.weights.contiguous()
    fusion = Fusion(
        address(weights, torch.double),
        weights.numel(),
        len(values),
        sampler._eps,
        sampler._alpha,
        level,
        bound,
        boost,
        _MARGIN,
        None if decay is None else address(decay, torch.double),
    )
    addresses = array("q", [address(value, torch.float) for value in values])
    if loops().update(
        addressof(replay), addressof(fusion), *batch, batches, addresses.buffer_info()[0]
    ):
        return None
    return weighing, fusion.highest, fusion.slot


@opaque
def write_compiled(
    sampler: SignalSampler,
    stored: Any,
    data: TensorDict,
    start: int,
    allow_nonfinite: Sequence[NestedKey],
) -> bool:
    """Write new transitions from a slot on, with their signals and the highest priority.

    Return False, and write nothing, for what PyTorch has to do, or find fault with.
    """
    table, count = sampler.table, len(data)
    key = table.reward_key
    columns: list[int] = []
    values: list[Tensor] = []  # Kept until they are written.
    allowed = {as_path(entry) for entry in allow_nonfinite} - {as_path(key)}
    if (
        not sampler.compiled
        or not 0 < count <= table.capacity
        or any(signal != replace(REWARD, key=key) for signal in table.written)
        # It is the one entry that may be absent.
        or data.get(INDEX_KEY, None) is not None
        or not match_rows(stored, data, count, columns, values, 1, allowed)
    ):
        return False
    reward, index = stored.get(key, None), stored.get(INDEX_KEY, None)
    if index is None or reward is None or not _fits(index, torch.long, table.capacity):
        return False
    place = columns[::WIDTH].index(reward.data_ptr())
    if reward.numel() != table.capacity or columns[WIDTH * place + WIDTH - 1] == 0:
        return False
    priority, replay = float(sampler._fresh_priority()), _replay(sampler)
    array_of_columns = array("q", columns)
    first = array_of_columns.buffer_info()[0]
    if loops().write_new(
        addressof(replay),
        first,
        len(columns) // WIDTH,
        start,
        count,
        first + 8 * WIDTH * place,
        address(index, torch.long),
        table.column.get(REWARD.name, -1),
        table.writes,
        priority,
        sampler._alpha,
    ):
        return False
    table.writes += count
    if sampler._highest is None:
        sampler.keep_highest(priority, start)
    return True


def _fits(value: Tensor, dtype: torch.dtype, count: int) -> bool:
    """Return True if a tensor, once it is contiguous, has so many numbers of a type for C."""
    fits = value.dtype is dtype and value.numel() == count and value.layout is torch.strided
    return fits and is_plain(value.contiguous())


@cache
def _decay(size: int, sharpness: float) -> Tensor:
    """Return the factors of Eq. (23) by place in a batch of one size, shape ``[B]``."""
    return factors_by_place(size, sharpness, torch.double, torch.device("cpu"))
