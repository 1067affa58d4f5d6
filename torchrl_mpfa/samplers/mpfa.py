"""The paper's sampler: MPFA-PER."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.utils import NestedKey

from torchrl_mpfa.adjustment import Adjustment, PositiveBoost, PositiveDecay
from torchrl_mpfa.checks import Level
from torchrl_mpfa.fusion import EntropyFusion, Fusion
from torchrl_mpfa.samplers.fused import SignalSampler
from torchrl_mpfa.samplers.table import Agents
from torchrl_mpfa.signals import MPFA_SIGNALS, Signal


class MPFASampler(SignalSampler):
    r"""The paper's replay: entropy-weighted signals, positive transitions boosted and decayed.

    :class:`SignalSampler` with the choices of MPFA-PER: the signals of Eqs. (12)-(14), the weights
    of Eqs. (16)-(20), and the adjustments of Eqs. (22)-(24).

    Cheng et al. (2023), https://doi.org/10.3389/fnbot.2023.1281166

    Args:
        max_capacity: Capacity of the storage ``N``; by default that of the buffer's storage.
        alpha: Priority exponent :math:`\alpha` of Eq. (8).
        beta: Importance exponent :math:`\beta` of Eq. (10), to be raised to 1 over the training.
        eps: :math:`\epsilon` of Eq. (21).
        dtype: Type of the importance weights.
        reduction: As in TorchRL.
        max_priority_within_buffer: True: fresh transitions get the highest priority in the buffer.
        device: Device of priorities and sampled slots; by default that of the storage.
        stratified: True to sample one slot from each of ``B`` parts.
        signals: By default the paper's three.
        fusion: By default :class:`~torchrl_mpfa.EntropyFusion`.
        adjustments: By default :class:`~torchrl_mpfa.PositiveBoost`, then
            :class:`~torchrl_mpfa.PositiveDecay`.
        positive_above: A transition is positive when its reward is above this: a number (0 in the
            paper), or ``"mean"``, the mean reward of the buffer. It holds for the entropy of Eq.
            (17), the boost and the decay alike. Where all rewards have one sign, 0 makes all of
            them the same: the TD error and the gradient then get no weight. With ``"mean"`` the
            three weights are equal for any data.
        entropy_refresh: As in :class:`SignalSampler`.
        reward_key: Where the signed reward of a transition is read.
        agents: Number of a transition where reward or signal has one for each agent: the largest by
            magnitude, ``"max"``, or the ``"mean"``; None: that is an error.

    Raises:
        ValueError: If an argument is out of its range.

    Warns:
        UserWarning: If ``positive_above`` is ``"mean"`` and the fusion counts entropies.

    Examples:
        >>> sampler = MPFASampler()
        >>> [type(adjust).__name__ for adjust in sampler.adjustments]
        ['PositiveBoost', 'PositiveDecay']
        >>> MPFASampler(positive_above=-1.0).positive_above
        -1.0
    """

    def __init__(
        self,
        max_capacity: int | None = None,
        alpha: float = 0.6,
        beta: float = 0.4,
        eps: float = 0.05,
        dtype: torch.dtype = torch.float,
        reduction: str = "max",
        max_priority_within_buffer: bool = True,
        device: torch.device | str | None = None,
        *,
        stratified: bool = False,
        signals: Sequence[Signal | str] = MPFA_SIGNALS,
        fusion: Fusion | None = None,
        adjustments: Sequence[Adjustment] | None = None,
        positive_above: Level = 0.0,
        entropy_refresh: float = 1 / 256,
        reward_key: NestedKey = ("next", "reward"),
        agents: Agents | None = None,
    ) -> None:
        super().__init__(
            max_capacity,
            alpha,
            beta,
            eps,
            dtype,
            reduction,
            max_priority_within_buffer,
            device,
            stratified=stratified,
            signals=signals,
            fusion=EntropyFusion() if fusion is None else fusion,
            adjustments=(PositiveBoost(), PositiveDecay()) if adjustments is None else adjustments,
            positive_above=positive_above,
            entropy_refresh=entropy_refresh,
            reward_key=reward_key,
            agents=agents,
        )
