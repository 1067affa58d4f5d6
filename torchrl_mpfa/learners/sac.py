"""SAC: actor, critics and temperature move at every update."""

from __future__ import annotations

from typing import Any

from torchrl_mpfa.checks import POSITIVE, check
from torchrl_mpfa.learners.base import ActorCriticLearner
from torchrl_mpfa.losses import SignalSACLoss


class SACLearner(ActorCriticLearner):
    r"""SAC: a stochastic actor, two critics and the temperature, each at every update.

    There is no target actor: :math:`\tau` is that of Eq. (7).

    Haarnoja et al. (2018), https://arxiv.org/abs/1812.05905

    Options: see :class:`~torchrl_mpfa.learners.ActorCriticLearner`.

    Args:
        loss: A :class:`~torchrl_mpfa.SignalSACLoss` with all networks in it.
        alpha_lr: Learning rate of the temperature's logarithm, unless that is fixed. The
            temperature takes some ``1 / alpha_lr`` updates to change by a factor of e.
        **kwargs: ``actor_lr``, ``critic_lr``, ``critic_weight_decay``, ``tau``, ``optimizer``,
            ``policy_delay``, ``compile``.

    Raises:
        TypeError: If the loss is another learner's.
        ValueError: If an argument is out of its range.

    Examples:
        >>> from torchrl_mpfa import make_critic, make_sac_loss, make_stochastic_actor
        >>> learner = SACLearner(make_sac_loss(make_stochastic_actor(24, 2), make_critic(24, 2)))
        >>> learner.policy.out_keys
        ['preactivation', 'scale', 'action']
    """

    loss_type = SignalSACLoss

    def __init__(self, loss: SignalSACLoss, *, alpha_lr: float = 3e-4, **kwargs: Any) -> None:
        check(POSITIVE, alpha_lr=alpha_lr)
        super().__init__(loss, **kwargs)
        if not loss.fixed_alpha:
            self._add_parameters([loss.log_alpha], lr=alpha_lr)
