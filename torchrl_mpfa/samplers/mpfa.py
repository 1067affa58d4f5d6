"""The paper's sampler: MPFA-PER."""

from __future__ import annotations

from typing import Any

from torchrl_mpfa.adjustment import Level, PositiveBoost, PositiveDecay
from torchrl_mpfa.checks import LEVEL, check
from torchrl_mpfa.fusion import EntropyFusion
from torchrl_mpfa.samplers.fused import SignalSampler
from torchrl_mpfa.signals import MPFA_SIGNALS


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
        *args: The further arguments of :class:`SignalSampler`, in its order.
        positive_above: A transition is positive when its reward is above this: a number (0 in the
            paper), or ``"mean"``, the mean reward of the buffer. It holds for the entropy of Eq.
            (17), the boost and the decay alike. Where all rewards have one sign, 0 makes all of
            them the same: the TD error and the gradient then get no weight. With ``"mean"`` the
            three weights are equal for any data.
        **kwargs: As :class:`SignalSampler`, all of whose arguments are taken. Those that are not
            given are the paper's: its three signals, :class:`~torchrl_mpfa.EntropyFusion`,
            :class:`~torchrl_mpfa.PositiveBoost` and :class:`~torchrl_mpfa.PositiveDecay`, and the
            highest priority within the buffer for fresh transitions.

    Raises:
        ValueError: If an argument is out of its range.

    Warns:
        UserWarning: If ``positive_above`` is ``"mean"`` and the fusion not one's own.

    Examples:
        >>> sampler = MPFASampler()
        >>> [type(adjust).__name__ for adjust in sampler.adjustments]
        ['PositiveBoost', 'PositiveDecay']
        >>> MPFASampler(positive_above=-1.0).fusion.positive_above
        -1.0
    """

    def __init__(
        self,
        max_capacity: int | None = None,
        alpha: float = 0.6,
        beta: float = 0.4,
        eps: float = 0.05,
        *args: Any,
        positive_above: Level = 0.0,
        **kwargs: Any,
    ) -> None:
        positive_above = check(LEVEL, positive_above=positive_above)
        # Positional as in TorchRL: dtype, reduction, max_priority_within_buffer, device.
        if len(args) < 3:
            kwargs.setdefault("max_priority_within_buffer", True)
        kwargs.setdefault("signals", MPFA_SIGNALS)
        own = [kwargs.get(name) is not None for name in ("fusion", "adjustments")]
        if all(own) and positive_above != 0.0:
            raise ValueError(
                f"positive_above must be given to a fusion and adjustments of your own, got "
                f"{positive_above!r} with them"
            )
        if not own[0]:
            kwargs["fusion"] = EntropyFusion(positive_above=positive_above)
        if not own[1]:
            kwargs["adjustments"] = (
                PositiveBoost(positive_above=positive_above),
                PositiveDecay(positive_above=positive_above),
            )
        super().__init__(max_capacity, alpha, beta, eps, *args, **kwargs)
