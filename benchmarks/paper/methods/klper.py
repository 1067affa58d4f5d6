r"""KLPER: train on the one of several batches that the current policy would most likely have made.

Cicek et al. (2021), "Off-policy correction for deep deterministic policy gradient algorithms via
batch prioritized experience replay", https://arxiv.org/abs/2111.01865. **A reconstruction**: the
abstract says that batches are prioritized, not transitions, and that the most on-policy one is
used. The measure here, the Kullback-Leibler divergence of a Gaussian fitted to the deviations of
the stored actions from the policy's, is that of a later method of the same group; the number of
batches, the direction of the divergence, and that actions nearer to the policy than its noise are
no further from it, are our reading.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer

from torchrl_mpfa.checks import COUNT, NOT_NEGATIVE, POSITIVE, check, check_counts
from torchrl_mpfa.methods import Method
from torchrl_mpfa.methods.base import within
from torchrl_mpfa.methods.ref_er import actions_of
from torchrl_mpfa.selection import SampledBatch, Selection, one_batch

_LEAST_VARIANCE = 1e-3


def gaussian_divergence(deviation: Tensor, *, variance: float) -> Tensor:
    r"""Divergence of stored actions from the policy's, against noise of a known variance.

    A Gaussian with mean :math:`m` and covariance :math:`C` is fitted to the deviations of each
    batch. With the eigenvalues :math:`\lambda_i` of :math:`C`, but none below :math:`v`, the
    divergence from :math:`N(0, v I)` is

    .. math::

        \tfrac12 \left( \sum_i \Big( \frac{\lambda_i}{v} - 1 - \ln \frac{\lambda_i}{v} \Big)
        + \frac{m^\top m}{v} \right)

    Without that bound, deviations *smaller* than the noise would count as far from the policy: of
    past episodes with less noise, of actions that were clipped to their range. Uniformly random
    actions, which are as wide as a noise of :math:`1/\sqrt3`, would then score better.

    Args:
        deviation: Stored actions less those of the policy, shape ``[..., B, A]``.
        variance: Variance :math:`v` of the exploration noise.

    Returns:
        The divergence of each batch, shape ``[...]``.

    Raises:
        ValueError: If the variance is not positive and finite.

    Examples:
        >>> off = torch.tensor([[-0.3], [0.3]])
        >>> near, far = (gaussian_divergence(off + shift, variance=0.09) for shift in (0.0, 1.0))
        >>> bool(near < far)
        True
    """
    check(POSITIVE, variance=variance)
    deviation = deviation.double()
    mean = deviation.mean(-2)
    centered = deviation - mean.unsqueeze(-2)
    covariance = centered.mT @ centered / deviation.shape[-2]
    wider = (torch.linalg.eigvalsh(covariance) / variance).clamp_min(1.0)
    return 0.5 * ((wider - 1.0 - wider.log()).sum(-1) + mean.square().sum(-1) / variance)


class KLPERSelection:
    """Keeps the most on-policy one of several batches that were sampled as one.

    In a training loop::

        select = KLPERSelection(policy, batches=3, sigma=lambda: float(noise.sigma))
        batch = select(buffer.sample(3 * 256))

    Args:
        policy: The current policy, on any device; writes the action.
        batches: Number of batches ``K`` to choose from.
        sigma: Standard deviation of the exploration noise in units of the action, or a function
            that returns that of the current episode.
        action_key: Key of the action.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_mpfa import make_actor
        >>> select = KLPERSelection(make_actor(24, 2), batches=2, sigma=0.2)
        >>> seen = TensorDict({"observation": torch.rand(8, 24), "action": torch.rand(8, 2)}, [8])
        >>> select(seen).batch_size
        torch.Size([4])
    """

    def __init__(
        self,
        policy: TensorDictModule,
        *,
        batches: int = 3,
        sigma: float | Callable[[], float],
        action_key: NestedKey = "action",
    ) -> None:
        self.policy = policy
        self.batches: int = check_counts(batches=batches)
        self.sigma = sigma if callable(sigma) else check(NOT_NEGATIVE, sigma=sigma)
        self.action_key = action_key

    def select(self, buffer: TensorDictReplayBuffer) -> Iterator[SampledBatch]:
        """Sample a batch and choose: a :class:`~torchrl_mpfa.selection.Selection`."""
        for sampled in one_batch(buffer):
            yield replace(sampled, batch=self(sampled.batch))

    @torch.no_grad()
    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Choose a batch.

        Args:
            tensordict: The sampled rows, batch size ``[K * B]``.

        Returns:
            The batch, batch size ``[B]``.

        Raises:
            ValueError: If the rows are no multiple of the number of batches.
        """
        count = len(tensordict)
        if count % self.batches:
            raise ValueError(f"{count} transitions cannot make {self.batches} equal batches")
        chosen = actions_of(self.policy, tensordict, action_key=self.action_key)
        deviation = tensordict.get(self.action_key) - chosen
        sigma = self.sigma() if callable(self.sigma) else self.sigma
        divergence = gaussian_divergence(
            deviation.reshape(self.batches, count // self.batches, -1),
            variance=max(sigma**2, _LEAST_VARIANCE),
        )
        return tensordict.reshape(self.batches, -1)[int(divergence.argmin())]


@dataclass
class KLPER(Method):
    """The most on-policy one of several uniform batches."""

    name: str = "klper"
    candidates: int = within(COUNT, 3)
    """Batches of which the most on-policy one is trained on."""
    needs: ClassVar[tuple[str, ...]] = ("policy", "sigma")
    why: ClassVar[str] = "it chooses on-policy batches"
    needs_actor: ClassVar[bool] = True

    @property
    def rows(self) -> int:
        """Transitions of all candidates."""
        return self.batch_size * self.candidates

    def selection(self, policy: Any, sigma: Any) -> Selection:
        """Make the selection of the nearest candidate."""
        return KLPERSelection(policy, batches=self.candidates, sigma=sigma).select
