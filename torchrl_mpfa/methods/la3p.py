r"""LA3P: the critic learns from large TD errors, the actor from small ones, both from a fair share.

Saglam et al. (2023), "Actor prioritized experience replay", Journal of Artificial Intelligence
Research 78, https://doi.org/10.1613/jair.1.14819. An actor that follows the critic where the critic
is wrong learns little: it gets transitions in proportion to the *inverse* of the priority.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer

from torchrl_mpfa.sampler import SignalSampler
from torchrl_mpfa.selection import Draw


class LA3PSampler(SignalSampler):
    r"""Draws three parts: uniformly, by priority, and by the inverse of the priority.

    A batch of ``T`` slots is ``U`` uniform ones, then ``P`` by priority, then ``P`` by its inverse;
    :meth:`drawn` says how many slots a batch of a given size takes, and :meth:`parts` where the
    parts end. All weights are 1.

    Args:
        *args: As :class:`~torchrl_mpfa.SignalSampler`.
        uniform_fraction: Share :math:`1 - \lambda` of a batch that is drawn uniformly.
        **kwargs: As :class:`~torchrl_mpfa.SignalSampler`.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> sampler = LA3PSampler(1000, 0.4, 0.0, signals=["td_error"])
        >>> sampler.drawn(256)
        384
    """

    def __init__(self, *args: Any, uniform_fraction: float = 0.5, **kwargs: Any) -> None:
        if not 0.0 < uniform_fraction < 1.0:
            raise ValueError(f"uniform_fraction must be in (0, 1), got {uniform_fraction}")
        self.uniform_fraction = uniform_fraction
        super().__init__(*args, **kwargs)

    def _init(self) -> None:
        super()._init()
        self._inverse_tree = type(self._sum_tree)(self._max_capacity)

    def _write(self, index: Tensor, priority: Tensor) -> None:
        super()._write(index, priority)
        self._inverse_tree[index] = 1.0 / self._leaf(priority)

    def drawn(self, batch_size: int) -> int:
        """Number of slots that a training step with batches of this size takes."""
        uniform = round(batch_size * self.uniform_fraction)
        return uniform + 2 * (batch_size - uniform)

    def parts(self, count: int) -> tuple[int, int]:
        """Where the uniform and the prioritized part of so many slots end.

        Raises:
            ValueError: If the slots cannot be parted.
        """
        uniform = round(count * self.uniform_fraction / (2.0 - self.uniform_fraction))
        if uniform < 1 or uniform >= count or (count - uniform) % 2:
            raise ValueError(
                f"batch_size must be one that drawn() gives, got {count} for a uniform_fraction "
                f"of {self.uniform_fraction}"
            )
        return uniform, (count + uniform) // 2

    def _draw(self, size: int, batch_size: int) -> tuple[Tensor, Tensor]:
        uniform, prioritized = self.parts(batch_size)
        index = torch.cat(
            (
                torch.randint(size, (uniform,), generator=self._rng),
                self._proportional(self._sum_tree, size, prioritized - uniform),
                self._proportional(self._inverse_tree, size, batch_size - prioritized),
            )
        )
        return index, torch.ones(batch_size)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave.

        Raises:
            ValueError: See :meth:`check_state`.
        """
        super().load_state_dict(state_dict)
        written = (state_dict["_max_tree"] <= 0).nonzero().squeeze(1)
        if len(written):
            self._inverse_tree[written] = 1.0 / state_dict["_sum_tree"][written]


def split_draws(buffer: TensorDictReplayBuffer) -> Sequence[Draw]:
    """The two updates of an LA3P step, out of one sample of a buffer with :class:`LA3PSampler`.

    Critic and actor learn from the uniform part, with the loss PAL; then the critic from the
    prioritized part, with the Huber loss, and the actor from the inverse one.

    Args:
        buffer: The buffer, whose batch size is one that :meth:`LA3PSampler.drawn` gives.

    Returns:
        Two draws.

    Raises:
        TypeError: If the buffer has another sampler.
    """
    sampler = buffer.sampler
    if not isinstance(sampler, LA3PSampler):
        raise TypeError(f"buffer must have an LA3PSampler, got {type(sampler).__name__}")
    batch = buffer.sample()
    uniform, prioritized = sampler.parts(len(batch))
    return [
        Draw(batch[:uniform], loss_function="pal"),
        Draw(
            batch[uniform:prioritized],
            actor_batch=batch[prioritized:],
            loss_function="smooth_l1",
        ),
    ]
