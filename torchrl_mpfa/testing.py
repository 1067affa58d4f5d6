"""One check of your own sampler, fusion or adjustment, for your own tests.

It trains with the part in a buffer. It raises what the buffer raises, or an :class:`AssertionError`
with a sentence that says what is wrong, and returns nothing otherwise::

    from torchrl_mpfa.testing import check_sampler

    def test_my_parts():
        check_sampler(lambda: MySampler(64, 0.6, 0.4, 0.05))
        check_sampler(lambda: SignalSampler(
            64, 0.6, 0.4, 0.05, signals=["reward", "mine"], fusion=Mine(), adjustments=[MyBoost()]
        ))
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, is_tensor_collection
from torch import Tensor

from torchrl_mpfa.buffer import SignalReplayBuffer
from torchrl_mpfa.fusion import checked_weights
from torchrl_mpfa.samplers.fused import SignalSampler
from torchrl_mpfa.storages.tensor import SignalTensorStorage

_SAMPLES = 50_000
_SPREAD = 5.0
"""Standard deviations by which a frequency may miss its probability."""


def check_sampler(make_sampler: Callable[[], SignalSampler], *, batch_size: int = 16) -> None:
    """Check a sampler in a buffer, with its fusion and adjustments.

    Slots are sampled in proportion to the leaves of its tree, weights are finite and in (0, 1],
    batches and priorities after loading equal those without, to the last bit, and a rejected update
    or state changes nothing. For rewards of any sign and scale the fusion gives one weight a
    signal, in any order of signals. Training changes no reward.

    Args:
        make_sampler: Makes a new sampler, the same each time.
        batch_size: ``B`` of the batches that are sampled.

    Raises:
        AssertionError: If one of them does not hold.
        ValueError: If weights or priorities have a wrong shape, are negative or not finite.

    Examples:
        >>> from torchrl_mpfa import Adjustment, MPFASampler, SignalSampler
        >>> check_sampler(lambda: MPFASampler(32))
        >>> class Wrong(Adjustment):
        ...     def __call__(self, priority, batch):
        ...         return -priority
        >>> check_sampler(lambda: SignalSampler(32, 0.6, 0.4, 0.05, adjustments=[Wrong()]))
        Traceback (most recent call last):
            ...
        ValueError: adjusted priorities must be finite and not negative, got -...
    """
    for fraction, scale, offset in ((0.0, 1.0, 9.0), (0.5, 1.0, -9.0), (1.0, 0.0, 0.0)):
        sampler = make_sampler()
        sampler.anneal(fraction)
        _check_weights(_trained(sampler, 1, scale=scale, offset=offset).sampler)
    buffer = _trained(make_sampler(), batch_size)
    _check_weights(buffer.sampler)
    _check_batch(buffer, batch_size)
    _check_round_trip(buffer, _trained(make_sampler(), batch_size, seed=1))
    _check_rejections(buffer)
    _check_frequencies(buffer)


def _trained(
    sampler: SignalSampler,
    batch_size: int = 16,
    *,
    seed: int = 0,
    scale: float = 1.0,
    offset: float = 0.0,
) -> SignalReplayBuffer:
    """Return a buffer that has wrapped and was trained with, but for its newest transitions."""
    generator = torch.Generator().manual_seed(seed)
    capacity = sampler.max_size
    buffer = SignalReplayBuffer(
        storage=SignalTensorStorage(capacity),
        sampler=sampler,
        batch_size=batch_size,
        generator=generator,
    )
    for count in (capacity, max(capacity // 3, 1)):
        reward = torch.randn(count, 1, generator=generator) * scale + offset
        data = TensorDict({"next": {"reward": reward}}, [count])
        for signal in sampler.signals:
            if signal.known_at == "write" and data.get(signal.key, None) is None:
                data.set(signal.key, torch.rand(count, generator=generator))
        buffer.extend(data)
        rewards = buffer.rewards().clone()
        _train(buffer, 8 if count == capacity else 2)
        _require(torch.equal(rewards, buffer.rewards()), "training must not change the rewards")
    return buffer


def _train(buffer: SignalReplayBuffer, rounds: int, *, seed: int = 2) -> Tensor:
    """Sample and update for some rounds; return the sampled slots."""
    generator = torch.Generator().manual_seed(seed)
    slots = []
    for _ in range(rounds):
        batch = buffer.sample()
        slots.append(batch["index"].clone())
        for signal in buffer.sampler.signals:
            if signal.known_at == "update":
                batch.set(signal.key, torch.rand(len(batch), generator=generator) * 3 + 0.01)
        buffer.update_tensordict_priority(batch)
    return torch.cat(slots)


def _check_weights(sampler: SignalSampler) -> None:
    table = sampler.table
    names, index = [*table.names[table.fused]], torch.arange(0, table.size, 3)
    weights, turned = (
        checked_weights(sampler.fusion, order, table, index) for order in (names, names[::-1])
    )
    _require(bool(weights.sum() > 0), f"one weight must be positive, got {weights.tolist()}")
    _require(
        torch.allclose(turned.flip(0), weights),
        f"weights must follow the order of names: {weights.tolist()} for {names}, "
        f"{turned.tolist()} in reverse order",
    )


def _check_batch(buffer: SignalReplayBuffer, batch_size: int) -> None:
    batch = buffer.sample()
    index, weight = batch["index"], batch["priority_weight"]
    _require(
        index.shape == weight.shape == (batch_size,) and index.dtype is torch.long,
        f"a batch must have {batch_size} integer slots and weights, got {index.dtype} of shape "
        f"{[*index.shape]} and {[*weight.shape]}",
    )
    _require(
        bool(((index >= 0) & (index < len(buffer))).all()),
        f"slots must be in [0, {len(buffer)}), got {index.tolist()}",
    )
    _require(
        bool(((weight > 0) & (weight <= 1 + 1e-6)).all()),
        f"priority_weight must be in (0, 1], got {weight.tolist()}",
    )


def _check_round_trip(first: SignalReplayBuffer, second: SignalReplayBuffer) -> None:
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    states = [buffer.sampler.state_dict() for buffer in (first, second)]
    _require(_same(*states), "a sampler that loaded a state must have that state")
    slots = [_train(buffer, 6, seed=4) for buffer in (first, second)]
    states = [buffer.sampler.state_dict() for buffer in (first, second)]
    _require(
        torch.equal(*slots) and _same(*states),
        "a sampler that loaded a state must sample and update as the one that saved it",
    )


def _check_rejections(buffer: SignalReplayBuffer) -> None:
    sampler, before = buffer.sampler, copy.deepcopy(buffer.state_dict())
    slots, ones, state = torch.tensor([0, 1]), torch.ones(2), sampler.state_dict()
    wrong: list[tuple[str, Callable[..., object], tuple[Any, ...]]] = [
        ("a slot outside", sampler.update_priority, (slots * sampler.max_size, ones)),
        ("a mask as index", sampler.update_priority, (slots == 0, ones)),
    ]
    for number in (math.nan, math.inf, -1.0):
        priority = torch.tensor([1.0, number])
        wrong.append((f"a priority of {number}", sampler.update_priority, (slots, priority)))
    for name in state.keys() - {"_schema_version"}:
        rest = {key: value for key, value in state.items() if key != name}
        wrong.append((f"a state without {name}", sampler.load_state_dict, (rest,)))
    for what, call, arguments in wrong:
        try:
            call(*arguments)
        except (ValueError, IndexError, TypeError, KeyError):
            unchanged = _same(before, buffer.state_dict())
            _require(unchanged, f"{what} was rejected, but changed the sampler")
        else:
            raise AssertionError(f"{what} must be rejected")


def _check_frequencies(buffer: SignalReplayBuffer) -> None:
    # Not more at once than a sampler with a cap can sample by priority.
    size = len(buffer)
    leaf = buffer.sampler.trees.leaves(torch.arange(size))
    expected = leaf / leaf.sum()
    rounds = range(math.ceil(_SAMPLES / size))
    slots = torch.cat([buffer.sampler._sampled(buffer.storage, size)[0] for _ in rounds])
    frequency = torch.bincount(slots, minlength=size).double() / len(slots)
    sigma = (expected * (1 - expected) / len(slots)).sqrt()
    excess = (frequency - expected).abs() - _SPREAD * sigma
    worst = int(excess.argmax())
    _require(
        bool(excess[worst] < 1e-9),
        f"slot {worst} must be sampled with probability {expected[worst]:.4f}, as its leaf has it, "
        f"and was with {frequency[worst]:.4f}",
    )


def _same(first: Any, second: Any) -> bool:
    """Return True if two states are equal to the last bit, with NaN equal to NaN."""
    if isinstance(first, Tensor):
        alike = (first.shape, first.dtype) == (second.shape, second.dtype)
        return alike and bool(((first == second) | ((first != first) & (second != second))).all())
    if is_tensor_collection(first) or isinstance(first, dict):
        keys = [*first.keys()]
        return {*keys} == {*second.keys()} and all(_same(first[key], second[key]) for key in keys)
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(map(_same, first, second))
    return bool(first == second)


def _require(holds: bool, text: str) -> None:
    if not holds:
        raise AssertionError(text)
