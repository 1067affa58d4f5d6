r"""Replay by age: the older a transition, the less often, by a truncated geometric law.

After Korniak et al. (2026), "When does non-uniform replay matter in reinforcement learning?",
https://arxiv.org/abs/2605.10236. **A reconstruction**: that replay by a truncated geometric law
prefers recent transitions is said by its abstract; the form and the rate are our reading:

.. math::

    P(k) = \frac{\rho (1 - \rho)^k}{1 - (1 - \rho)^N}, \qquad k = 0, \dots, N - 1, \qquad
    \rho = 1 - e^{-c / N}

where the age :math:`k` of a transition counts those that were written after it. The rate
:math:`\rho` follows the number :math:`N` of transitions in the buffer, so that the newest is
always sampled :math:`e^c` times as often as the oldest.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Storage

from torchrl_mpfa.checks import NOT_NEGATIVE, check, generator_on
from torchrl_mpfa.samplers.uniform import NewestSampler


def geometric_age(share: Tensor, *, rate: float, count: int) -> Tensor:
    r"""Compute the age below which a share of a truncated geometric law lies.

    The inverse of its distribution function,
    :math:`k = \lfloor \ln(1 - u (1 - (1 - \rho)^N)) / \ln(1 - \rho) \rfloor`: of shares that are
    uniform in [0, 1) the ages follow the law.

    Args:
        share: Shares :math:`u`, in double precision, shape ``[B]``.
        rate: :math:`\rho` in [0, 1); 0 is the limit, uniform ages.
        count: Number of ages ``N``.

    Returns:
        Ages from 0 to ``N - 1``, shape ``[B]``.

    Examples:
        >>> share = torch.tensor([0.0, 0.5, 0.99], dtype=torch.double)
        >>> geometric_age(share, rate=0.5, count=100).tolist()
        [0, 1, 6]
    """
    if rate == 0:
        age = share * count
    else:
        step = math.log1p(-rate)
        # log1p and expm1 keep digits that a small rate would lose next to 1.
        age = torch.log1p(share * math.expm1(count * step)) / step
    # Rounding can carry the last share one age too far.
    return age.long().clamp_(0, count - 1)


class GeometricSampler(NewestSampler):
    r"""Samples the newest transition :math:`e^c` times as often as the oldest in the buffer.

    In between, each is sampled :math:`e^{-c / N}` times as often as the one after it, where the
    buffer holds ``N``. Ages are those of the ring buffer. In a storage of several dimensions age
    goes along the first, time, and the other places are uniform.

    Args:
        recency: :math:`c`; the age at which a transition is sampled half as often as the newest is
            :math:`0.69 N / c`. With 0 sampling is uniform.

    Raises:
        ValueError: If ``recency`` is negative or not finite.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> buffer = TensorDictReplayBuffer(
        ...     storage=LazyTensorStorage(1000), sampler=GeometricSampler(recency=99), batch_size=64
        ... )
        >>> index = buffer.extend(TensorDict({"reward": torch.rand(1000)}, [1000]))
        >>> bool(buffer.sample()["index"].min() > 800)
        True
    """

    def __init__(self, *, recency: float = 3.0) -> None:
        super().__init__()
        self.recency: float = check(NOT_NEGATIVE, recency=recency)

    @property
    def divisible(self) -> bool:
        """True if ``U * B`` slots, sampled at once, can be split into ``U`` batches of ``B``."""
        return True

    def sample(self, storage: Storage, batch_size: int) -> tuple[Any, dict[str, Any]]:
        """Sample slots, in the form of TorchRL's ``RandomSampler``."""
        index, info = super().sample(storage, batch_size)
        if self.newest is None:
            return index, info
        along = index if isinstance(index, tuple) else (index,)
        around = len(storage) if len(along) == 1 else storage._len_along_dim0
        where = along[0].device
        generator = generator_on(where, storage._rng)
        share = torch.rand(batch_size, generator=generator, dtype=torch.double, device=where)
        rate = -math.expm1(-self.recency / around)
        age = geometric_age(share, rate=rate, count=around)
        along[0].copy_((self.newest[0] - age) % around)
        return index, info
