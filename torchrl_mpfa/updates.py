"""The learner's side of one iteration: several updates for the transitions of several robots.

The batches of all updates are sampled in one call and their priorities written in one, which costs
a fraction of as many calls; the price is that no batch knows of the updates just before it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import RandomSampler, TensorDictReplayBuffer
from torchrl.data.replay_buffers import PrioritizedSampler

from torchrl_mpfa.checks import check_counts
from torchrl_mpfa.learners.base import Learner
from torchrl_mpfa.samplers.fused import SignalSampler
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
        prepare: Applied to each batch before the learner gets it: to move it to the learner's
            device, or to add to its rewards. It keeps the rows of the batch and their order, and
            the learner as it is.

    Returns:
        Detached values for the log, of the last update; and its last batch with signals, where the
        buffer has its own.

    Raises:
        ValueError: If ``updates`` is not positive, or the buffer has no batch size or fewer
            transitions than one batch; nothing is changed.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_mpfa import ActorCriticLearner, make_actor, make_critic, make_ddpg_loss
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
        >>> learner = ActorCriticLearner(make_ddpg_loss(make_actor(24, 2), make_critic(24, 2)))
        >>> log, batch = run_updates(replay.buffer, learner, replay.select, updates=4)
        >>> learner.updates, batch["signals", "td_error"].shape
        (4, torch.Size([8]))
    """
    check_counts(updates=updates)
    batch_size = buffer.batch_size
    if batch_size is None:
        raise ValueError("buffer must have a batch_size, got None")
    if len(buffer) < batch_size:
        raise ValueError(
            f"buffer must hold at least one batch of {batch_size}, got {len(buffer)} transitions"
        )
    if updates > 1 and select is one_batch and _divides(buffer):
        return _together(buffer, learner, prepare, updates, batch_size)
    for _ in range(updates):
        log, batch = _one_by_one(buffer, learner, select, prepare)
    return log, batch


def _one_by_one(
    buffer: TensorDictReplayBuffer, learner: Learner, select: Selection, prepare: Prepare | None
) -> tuple[dict[str, Tensor], TensorDictBase]:
    """Make one update, whose batches may depend on the priorities of the update before."""
    log: dict[str, Tensor] = {}
    batch: TensorDictBase | None = None
    for sampled in select(buffer):
        learned, values = _learn(learner, sampled, prepare)
        log.update(values)
        if sampled.gives_signals:
            batch = _at(learned, sampled.batch.device)
            buffer.update_tensordict_priority(batch)
    if batch is None:
        raise ValueError("select must give the critic a batch in each update, got none")
    return log, batch


def _together(
    buffer: TensorDictReplayBuffer,
    learner: Learner,
    prepare: Prepare | None,
    updates: int,
    batch_size: int,
) -> tuple[dict[str, Tensor], TensorDictBase]:
    """Make all updates of an iteration by one call to sample and one to write priorities."""
    # TorchRL warns of a batch size that is not the buffer's, which is meant here.
    buffer._warned_batch_size_conflict = True
    sampled = buffer.sample(updates * batch_size)
    log, learned, last = _learn_each(buffer, learner, prepare, sampled, batch_size)
    if getattr(buffer, "takes_signals", False):
        buffer.update_tensordict_priority(learned, batches=updates)
    elif isinstance(buffer.sampler, PrioritizedSampler):
        buffer.update_tensordict_priority(learned)
    return log, last


def _learn_each(
    buffer: TensorDictReplayBuffer,
    learner: Learner,
    prepare: Prepare | None,
    sampled: TensorDictBase,
    batch_size: int,
) -> tuple[dict[str, Tensor], TensorDictBase, TensorDictBase]:
    """Return values for the log, the signals of all batches, and the last batch with its own."""
    each = getattr(learner, "update_each", None)
    if prepare is None and each is not None and (log := each(sampled, batch_size)) is not None:
        return log, sampled, sampled[-batch_size:]
    batches = []
    for part in sampled.split(batch_size):
        batch, log = _learn(learner, SampledBatch(part), prepare)
        batches.append(batch)
    return log, _joined(buffer, sampled, batches), _at(batch, sampled.device)


def _learn(
    learner: Learner, sampled: SampledBatch, prepare: Prepare | None
) -> tuple[TensorDictBase, dict[str, Tensor]]:
    """Return the batch with its signals, and values for the log."""
    if prepare is not None:
        sampled = prepare(sampled)
    values = learner.update(sampled)
    return sampled.batch, values


def _joined(
    buffer: TensorDictReplayBuffer, sampled: TensorDictBase, batches: Sequence[TensorDictBase]
) -> TensorDictBase:
    """Join what the batches learned to the slots that were sampled, shape ``[U * B]``."""
    sampler, keys = buffer.sampler, [buffer.priority_key]
    if isinstance(sampler, SignalSampler):
        keys = [signal.key for signal in sampler.signals if signal.known_at == "update"]
    joined = sampled.select("index", "written_at", strict=False)
    for key in keys:
        values = [batch.get(key, None) for batch in batches]
        if all(value is not None for value in values):
            joined.set(key, torch.cat(values).to(sampled.device or "cpu"))
    return joined


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
