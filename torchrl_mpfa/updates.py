"""The learner's side of one iteration: several updates for the transitions of several robots.

The batches of all updates are sampled in one call and their priorities written in one, which costs
a fraction of as many calls; the price is that no batch knows of the updates just before it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import RandomSampler, TensorDictReplayBuffer
from torchrl.data.replay_buffers import PrioritizedSampler

from torchrl_mpfa.checks import check_counts
from torchrl_mpfa.learners import Learner
from torchrl_mpfa.selection import SampledBatch, Selection, one_batch

Prepare = Callable[[SampledBatch], SampledBatch]


def run_updates(
    buffer: TensorDictReplayBuffer,
    learner: Learner,
    select: Selection = one_batch,
    *,
    updates: int = 1,
    prepare: Prepare | None = None,
) -> tuple[dict[str, Tensor], TensorDictBase]:
    """Make the updates of one iteration.

    With ``one_batch`` the batches of all updates are sampled in one call, and
    their priorities are written in one at the end; of a transition that was sampled twice the last
    update counts. Any other selection, and a sampler whose batches are more than independent
    rows (stratified, with the newest transition in each), is asked update by update, and priorities
    are written after each batch.

    Args:
        buffer: Where batches of ``B`` are sampled, its own batch size.
        learner: The learner to train.
        select: Function from the buffer to the batches of an update.
        updates: Number of updates ``U``.
        prepare: Applied to what was sampled before the learner gets it: to move it to the learner's
            device, or to add to its rewards. It keeps the rows and their order, and the learner as
            it is. Batches that are sampled in one call it gets together, with their number in
            ``batches``.

    Returns:
        Detached values for the log, of the last update; and its last batch with signals, where the
        buffer has its own.

    Raises:
        ValueError: If ``updates`` is not positive, or the buffer has no batch size or fewer
            transitions than one batch; nothing is changed. Or, after the updates, if none of them
            had a batch for the critic.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_mpfa import ActorCritic, make_actor, make_critic
        >>> from torchrl_mpfa.methods import make_replay
        >>> replay = make_replay("mpfa_per", capacity=100, batch_size=8)
        >>> end = torch.zeros(32, 1, dtype=torch.bool)
        >>> after = {"observation": torch.rand(32, 24), "reward": torch.rand(32, 1)}
        >>> rows = {
        ...     "observation": torch.rand(32, 24),
        ...     "action": torch.rand(32, 2),
        ...     "next": {**after, "done": end, "terminated": end},
        ... }
        >>> index = replay.buffer.extend(TensorDict(rows, [32]))
        >>> learner = ActorCritic(make_actor(24, 2), make_critic(24, 2))
        >>> log, batch = run_updates(replay.buffer, learner, replay.select, updates=4)
        >>> learner.updates, batch["signals", "td_error"].shape
        (4, torch.Size([8]))
    """
    check_counts(updates=updates)
    size = buffer.batch_size
    if size is None:
        raise ValueError("buffer must have a batch_size, got None")
    if len(buffer) < size:
        raise ValueError(
            f"buffer must hold at least one batch of {size}, got {len(buffer)} transitions"
        )
    at_once = updates if select is one_batch and _divides(buffer) else 1
    log: dict[str, Tensor] = {}
    last: TensorDictBase | None = None
    for _ in range(updates // at_once):
        for sampled in select(buffer) if at_once == 1 else [_sample(buffer, at_once)]:
            home, prepared = sampled.batch.device, prepare(sampled) if prepare else sampled
            keys = _learned_keys(buffer)
            log.update(_learn(learner, prepared, keys))
            if prepared.gives_signals:
                _write_priorities(buffer, prepared, keys, home)
                last = _at(prepared.batch[-(len(prepared.batch) // prepared.batches) :], home)
    if last is None:
        raise ValueError("select must give the critic a batch in each update, got none")
    return log, last


def _sample(buffer: TensorDictReplayBuffer, batches: int) -> SampledBatch:
    """Sample several batches by one call."""
    # TorchRL warns of a batch size that is not the buffer's, which is meant here.
    buffer._warned_batch_size_conflict = True
    return SampledBatch(buffer.sample(batches * buffer.batch_size), batches=batches)


def _learn(learner: Learner, sampled: SampledBatch, keys: Sequence[NestedKey]) -> dict[str, Tensor]:
    """Make an update with each batch, which write these entries; return values for the log."""
    update_each = getattr(learner, "update_each", None) if sampled.batches > 1 else None
    if update_each and (log := update_each(sampled.batch, sampled.batches)) is not None:
        return dict(log)
    parts = sampled.parts()
    for part in parts:
        log = learner.update(part)
    for key in keys if len(parts) > 1 else ():
        values = [part.batch.get(key, None) for part in parts]
        if all(value is not None for value in values):
            sampled.batch.set(key, torch.cat(values))
    return log


def _write_priorities(
    buffer: TensorDictReplayBuffer,
    sampled: SampledBatch,
    keys: Sequence[NestedKey],
    home: torch.device | None,
) -> None:
    """Write the priorities of what was sampled, by these entries."""
    rows = sampled.batch.select("index", "written_at", *keys, strict=False)
    several = {"batches": sampled.batches} if getattr(buffer, "takes_signals", False) else {}
    buffer.update_tensordict_priority(_at(rows, home), **several)


def _learned_keys(buffer: TensorDictReplayBuffer) -> list[NestedKey]:
    """Return the entries that priorities are made of, which an update writes."""
    signals = getattr(buffer.sampler, "signals", ())
    return [*(s.key for s in signals if s.known_at == "update"), buffer.priority_key]


def _at(batch: TensorDictBase, device: torch.device | None) -> TensorDictBase:
    """Move a batch to the device of its rows, of which None is the CPU."""
    return batch if batch.device == device else batch.to(device or "cpu")


def _divides(buffer: TensorDictReplayBuffer) -> bool:
    """Return True if ``U * B`` rows, sampled at once, are ``U`` batches of ``B``."""
    sampler = buffer.sampler
    of_torchrl = type(sampler) in (RandomSampler, PrioritizedSampler)
    alone = of_torchrl or bool(getattr(sampler, "divisible", False))
    # TorchRL's buffer may sample ahead, each batch by itself.
    return alone and not getattr(buffer, "_prefetch", False)
