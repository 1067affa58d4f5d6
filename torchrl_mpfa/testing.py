"""Checks of your own samplers, fusions and adjustments, for your own tests.

Each function raises an :class:`AssertionError` with a sentence that says what is wrong, and returns
nothing otherwise::

    from torchrl_mpfa.testing import check_adjustment, check_fusion, check_sampler

    def test_my_parts():
        check_adjustment(MyAdjustment())
        check_fusion(MyFusion(), ["reward", "td_error"])
        check_sampler(lambda: MySampler(64, 0.6, 0.4, 0.05))
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, is_tensor_collection
from torch import Tensor

from torchrl_mpfa.adjustment import Adjustment, BatchFacts
from torchrl_mpfa.buffer import SignalReplayBuffer
from torchrl_mpfa.fusion import Fusion
from torchrl_mpfa.samplers.fused import SignalSampler
from torchrl_mpfa.samplers.table import SignalTable
from torchrl_mpfa.signals import Signal
from torchrl_mpfa.storages.tensor import SignalTensorStorage

_SAMPLES = 50_000
_SPREAD = 5.0
"""Standard deviations by which a frequency may miss its probability."""


def check_adjustment(adjustment: Adjustment) -> None:
    """Check that an adjustment keeps priorities in order.

    Priorities of a batch are adjusted to as many, finite and not negative; what was handed in stays
    as it is; the same comes out twice; and a batch of one works.

    Args:
        adjustment: The adjustment.

    Raises:
        AssertionError: If it does not.

    Examples:
        >>> from torchrl_mpfa import PositiveBoost
        >>> check_adjustment(PositiveBoost(boost=2.0))
        >>> class Wrong(PositiveBoost):
        ...     def __call__(self, priority, batch):
        ...         return -priority
        >>> check_adjustment(Wrong())
        Traceback (most recent call last):
            ...
        AssertionError: adjusted priorities must be finite and not negative, got -...
    """
    _require(isinstance(adjustment, Adjustment), "an adjustment must be a torchrl_mpfa.Adjustment")
    generator = torch.Generator().manual_seed(0)
    for count in (1, 2, 64):
        priority = torch.rand(count, generator=generator, dtype=torch.double) * 5 + 0.01
        reward = torch.randn(count, generator=generator, dtype=torch.double) * 3
        replays = torch.randint(1, 50, (count,), generator=generator).double()
        facts = BatchFacts(reward, replays, torch.arange(count), level=float(reward.mean()))
        if adjustment.counts:
            table = _table(("reward", "td_error"), scale=1.0, offset=0.0)
            known = table.rows[: table.size, : len(table.names)].sum(1)
            facts = replace(facts, counted=adjustment.count(table, known))
        before = [each.clone() for each in (priority, reward, replays)]
        found = adjustment(priority, facts)
        _require(
            isinstance(found, Tensor) and found.shape == priority.shape,
            f"adjusted priorities must have shape [{count}], got {_shape(found)}",
        )
        _require_priorities("adjusted priorities", found)
        unchanged = all(map(torch.equal, before, (priority, reward, replays)))
        _require(unchanged, "an adjustment must not change what it is given")
        _require(
            torch.equal(found, adjustment(priority, facts)),
            "an adjustment must give the same for the same batch",
        )


def check_fusion(
    fusion: Fusion, signals: Sequence[Signal | str] = ("reward", "td_error", "action_gradient")
) -> None:
    """Check that a fusion gives one weight a signal, for rewards of any sign and scale.

    Weights are finite, not negative, not all zero, and the same for the same buffer; the buffer
    stays as it is; and a signal gets the same weight in any order of signals.

    Args:
        fusion: The fusion.
        signals: The signals that it is meant for.

    Raises:
        AssertionError: If it does not.

    Examples:
        >>> from torchrl_mpfa import EntropyFusion
        >>> check_fusion(EntropyFusion())
    """
    _require(isinstance(fusion, Fusion), "a fusion must be a torchrl_mpfa.Fusion")
    for fraction in (0.0, 0.5, 1.0):
        fusion.anneal(fraction)
        for scale, offset in ((1.0, 0.0), (1.0, 9.0), (1.0, -9.0), (0.0, 0.0)):
            table = _table(signals, scale=scale, offset=offset)
            _check_weights(fusion, table, torch.arange(0, table.size, 3))


def _check_weights(fusion: Fusion, table: SignalTable, index: Tensor) -> None:
    names, before = list(table.names), table.rows.clone()
    found = fusion.weights(names, table, index)
    _require(
        isinstance(found, Tensor) and found.shape == (len(names),),
        f"a fusion must give one weight for each of {names}, got {_shape(found)}",
    )
    _require_priorities("weights", found)
    _require(bool(found.sum() > 0), f"one of the weights must be positive, got {found.tolist()}")
    _require(
        torch.equal(table.rows.nan_to_num(), before.nan_to_num()),
        "a fusion must not change the signals of the buffer",
    )
    turned = fusion.weights(names[::-1], table, index)
    _require(
        torch.allclose(turned.flip(0).double(), found.double()),
        f"weights must follow the order of names: {found.tolist()} for {names}, "
        f"{turned.tolist()} in reverse order",
    )


def _table(signals: Sequence[Signal | str], *, scale: float, offset: float) -> SignalTable:
    """Return a table with forty of fifty slots filled, ten of them without learned signals."""
    generator = torch.Generator().manual_seed(0)
    table = SignalTable(50, signals)
    reward = torch.randn(40, generator=generator, dtype=torch.double) * scale + offset
    rows = table.rows[:40].clone()
    rows[:, : len(table.names)] = torch.rand(
        40, len(table.names), generator=generator, dtype=torch.double
    )
    for signal in table.learned:
        rows[:10, table.column[signal.name]] = torch.nan
    rows[:, table.reward_column] = reward
    rows[:, table.count_column] = 1.0
    table.write(torch.arange(40), rows)
    table.size = 40
    return table


def check_sampler(make_sampler: Callable[[], SignalSampler], *, batch_size: int = 16) -> None:
    """Check a sampler in a buffer: frequencies, weights, saving and rejected input.

    Slots are sampled in proportion to the leaves of its tree, weights are finite and in (0, 1],
    batches after loading equal those without, to the last bit, and a rejected update or state
    changes nothing.

    Args:
        make_sampler: Makes a new sampler, the same each time.
        batch_size: ``B`` of the batches that are sampled.

    Raises:
        AssertionError: If one of them does not hold.

    Examples:
        >>> from torchrl_mpfa import MPFASampler
        >>> check_sampler(lambda: MPFASampler(32))
    """
    buffer = _buffer(make_sampler(), batch_size, seed=0)
    _train(buffer, 8)
    _check_batch(buffer, batch_size)
    _check_round_trip(buffer, _buffer(make_sampler(), batch_size, seed=1))
    _check_rejections(buffer)
    _check_frequencies(buffer)


def _buffer(sampler: SignalSampler, batch_size: int, *, seed: int) -> SignalReplayBuffer:
    """Return a buffer that has wrapped, with random rewards and signals known at the write."""
    generator = torch.Generator().manual_seed(seed)
    capacity = sampler.max_size
    buffer = SignalReplayBuffer(
        storage=SignalTensorStorage(capacity),
        sampler=sampler,
        batch_size=batch_size,
        generator=generator,
    )
    for count in (capacity, max(capacity // 3, 1)):
        data = TensorDict({"next": {"reward": torch.randn(count, 1, generator=generator)}}, [count])
        for signal in sampler.signals:
            if signal.known_at == "write" and data.get(signal.key, None) is None:
                data.set(signal.key, torch.rand(count, generator=generator))
        buffer.extend(data)
    return buffer


def _train(buffer: SignalReplayBuffer, rounds: int, *, seed: int = 2) -> Tensor:
    """Sample and update for some rounds; return the sampled slots."""
    generator = torch.Generator().manual_seed(seed)
    sampled = []
    for _ in range(rounds):
        batch = buffer.sample()
        sampled.append(batch["index"].clone())
        buffer.update_tensordict_priority(_with_signals(buffer, batch, generator))
    return torch.cat(sampled)


def _with_signals(buffer: SignalReplayBuffer, batch: Any, generator: torch.Generator) -> Any:
    for signal in buffer.sampler.signals:
        if signal.known_at == "update":
            batch.set(signal.key, torch.rand(len(batch), generator=generator) * 3 + 0.01)
    return batch


def _check_batch(buffer: SignalReplayBuffer, batch_size: int) -> None:
    batch = buffer.sample()
    index, weight = batch["index"], batch["priority_weight"]
    _require(
        index.shape == (batch_size,) and index.dtype is torch.long,
        f"a batch must have {batch_size} integer slots, got {index.dtype} {_shape(index)}",
    )
    _require(
        bool(((index >= 0) & (index < len(buffer))).all()),
        f"slots must be in [0, {len(buffer)}), got {index.tolist()}",
    )
    _require(
        weight.shape == (batch_size,),
        f"priority_weight must have shape [{batch_size}], got {_shape(weight)}",
    )
    _require(
        bool(((weight > 0) & (weight <= 1 + 1e-6)).all()),
        f"priority_weight must be in (0, 1], got {weight.tolist()}",
    )
    priorities = buffer.sampler.priorities(index)
    _require_priorities("priorities of written slots", priorities)


def _check_round_trip(first: SignalReplayBuffer, second: SignalReplayBuffer) -> None:
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    _require(
        _same(first.sampler.state_dict(), second.sampler.state_dict()),
        "a sampler that loaded a state must have that state",
    )
    third = copy.deepcopy(first.state_dict())
    sampled = [_train(buffer, 6, seed=4) for buffer in (first, second)]
    _require(
        torch.equal(*sampled), "a sampler that loaded a state must sample as the one that saved it"
    )
    first.load_state_dict(third)


def _check_rejections(buffer: SignalReplayBuffer) -> None:
    sampler, before = buffer.sampler, copy.deepcopy(buffer.state_dict())
    slots = torch.tensor([0, 1])
    calls: list[tuple[str, Callable[[], object]]] = []
    for wrong in (math.nan, math.inf, -1.0):
        priority = torch.tensor([1.0, wrong])
        update = partial(sampler.update_priority, slots, priority)
        calls.append((f"a priority of {wrong}", update))
    outside = torch.tensor([0, sampler.max_size])
    calls.append(("a slot outside", lambda: sampler.update_priority(outside, torch.ones(2))))
    mask = torch.tensor([True, False])
    calls.append(("a mask as index", lambda: sampler.update_priority(mask, torch.ones(2))))
    for name in sampler.state_dict():
        if name == "_schema_version":
            continue
        state = {key: value for key, value in sampler.state_dict().items() if key != name}
        calls.append((f"a state without {name}", partial(sampler.load_state_dict, state)))
    for what, call in calls:
        try:
            call()
        except (ValueError, IndexError, TypeError, KeyError):
            pass
        else:
            _require(False, f"{what} must be rejected")
        _require(
            _same(before, buffer.state_dict()), f"{what} was rejected, but changed the sampler"
        )


def _check_frequencies(buffer: SignalReplayBuffer) -> None:
    slots = torch.arange(len(buffer))
    leaf = torch.as_tensor(buffer.sampler._sum_tree[slots]).reshape(-1).double()
    expected = leaf / leaf.sum()
    # Not more at once than a sampler with a cap can sample by priority.
    at_once = len(buffer)
    rounds = math.ceil(_SAMPLES / at_once)
    sampled = torch.cat(
        [buffer.sampler._sampled(buffer.storage, at_once)[0] for _ in range(rounds)]
    )
    found = torch.bincount(sampled, minlength=len(buffer)).double() / len(sampled)
    sigma = (expected * (1 - expected) / len(sampled)).sqrt()
    off = (found - expected).abs() - _SPREAD * sigma
    worst = int(off.argmax())
    _require(
        bool(off[worst] < 1e-9),
        f"slot {worst} must be sampled with probability {expected[worst]:.4f}, as its leaf has it, "
        f"and was with {found[worst]:.4f}",
    )


def _same(first: Any, second: Any) -> bool:
    """Return True if two states are equal to the last bit, with NaN equal to NaN."""
    if isinstance(first, Tensor):
        fits = isinstance(second, Tensor) and (first.shape, first.dtype) == (
            second.shape,
            second.dtype,
        )
        return fits and bool(((first == second) | ((first != first) & (second != second))).all())
    if is_tensor_collection(first) or isinstance(first, dict):
        return set(first.keys()) == set(second.keys()) and all(
            _same(first[key], second[key])
            for key in first.keys()  # noqa: SIM118
        )
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(map(_same, first, second))
    return bool(first == second)


def _require_priorities(what: str, values: Tensor) -> None:
    wrong = values[~((values >= 0) & (values < math.inf))]
    _require(
        len(wrong) == 0,
        f"{what} must be finite and not negative, got {wrong[0].item() if len(wrong) else None}",
    )


def _shape(value: Any) -> str:
    return f"shape {[*value.shape]}" if isinstance(value, Tensor) else type(value).__name__


def _require(holds: bool, text: str) -> None:
    if not holds:
        raise AssertionError(text)
