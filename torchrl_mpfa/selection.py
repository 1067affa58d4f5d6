"""Selection: from a replay buffer to the batches of one training step.

Most methods sample one batch, of which critic and actor learn both. A method that chooses among
several batches, or gives critic and actor one each, is another callable of the same form.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal, Protocol, get_args, runtime_checkable

import torch
from tensordict import TensorDictBase
from torchrl.data import TensorDictReplayBuffer

Trains = Literal["both", "critic", "actor"]
"""The networks that learn from a batch."""
_TRAINS = get_args(Trains)


@dataclass(frozen=True)
class SampledBatch:
    """A batch of one update of a learner, and what learns from it; or several, sampled at once.

    Attributes:
        batch: The transitions, batch size ``[B]``, or ``[U * B]`` of several batches.
        trains: The networks that learn from them: ``"both"``, the ``"critic"`` or the ``"actor"``.
            The target networks move with the actor.
        loss_function: Distance of the critic's loss; None: the loss's own.
        new_step: True for the first batch of a training step; a delay of the actor does not count
            further batches of the same step.
        batches: Number ``U`` of batches of one size, one after the other, each of a training step
            of its own.

    Raises:
        ValueError: If ``trains`` is unknown.

    Examples:
        >>> from tensordict import TensorDict
        >>> SampledBatch(TensorDict({}, [4]), trains="actor").gives_signals
        False
    """

    batch: TensorDictBase
    trains: Trains = "both"
    loss_function: str | None = None
    new_step: bool = True
    batches: int = 1

    def __post_init__(self) -> None:
        if self.trains not in _TRAINS:
            raise ValueError(f"trains must be one of {_TRAINS}, got {self.trains!r}")

    @property
    def gives_signals(self) -> bool:
        """True if the update writes signals in the batch: the actor's loss has none."""
        return self.trains != "actor"

    def parts(self) -> list[SampledBatch]:
        """Return each batch by itself; tensors are views of those of all."""
        if self.batches == 1:
            return [self]
        rows = self.batch.split(len(self.batch) // self.batches)
        return [replace(self, batch=part, batches=1) for part in rows]

    def each(self, change: Callable[[TensorDictBase], None]) -> SampledBatch:
        """Change each batch by itself, in their order; return all of them."""
        parts = [part.batch for part in self.parts()]
        for batch in parts:
            change(batch)
        return replace(self, batch=torch.cat(parts))


def as_sampled(sampled: SampledBatch | TensorDictBase) -> SampledBatch:
    """Return what an update learns from, given as such or as a batch; reject several batches."""
    if not isinstance(sampled, SampledBatch):
        return SampledBatch(sampled)
    if sampled.batches > 1:
        raise ValueError(
            f"sampled must be one batch, got {sampled.batches}: update by each of sampled.parts()"
        )
    return sampled


@runtime_checkable
class Selection(Protocol):
    """A choice of the batches of a training step; any callable of this form will do.

    Batches come one by one, so that one can depend on what was learned from the one before::

        for sampled in select(buffer):
            losses = learner.update(sampled)
            if sampled.gives_signals:
                buffer.update_tensordict_priority(sampled.batch)
    """

    def __call__(self, buffer: TensorDictReplayBuffer) -> Iterator[SampledBatch]:
        """Sample the batches of one training step, each when it is asked for."""
        ...


def one_batch(buffer: TensorDictReplayBuffer) -> Iterator[SampledBatch]:
    """One batch for critic and actor, as the buffer samples it.

    Args:
        buffer: The replay buffer.

    Yields:
        One batch.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage
        >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10), batch_size=4)
        >>> index = buffer.extend(TensorDict({"reward": [[0.0]] * 10}, [10]))
        >>> [len(sampled.batch) for sampled in one_batch(buffer)]
        [4]
    """
    yield SampledBatch(buffer.sample())
