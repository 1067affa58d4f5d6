"""TD3: two critics at every update, the actor and the targets at every other one."""

from __future__ import annotations

from typing import Any

from torchrl_mpfa.learners.base import ActorCriticLearner
from torchrl_mpfa.losses import SignalTD3Loss


class TD3Learner(ActorCriticLearner):
    r"""TD3: two critics at each update, the actor and all targets at every other one.

    Fujimoto et al. (2018), https://arxiv.org/abs/1802.09477

    Options: see :class:`~torchrl_mpfa.learners.ActorCriticLearner`.

    Args:
        loss: A :class:`~torchrl_mpfa.SignalTD3Loss` with all networks in it.
        policy_delay: Updates of the critics for one of the actor and of the targets.
        **kwargs: ``actor_lr``, ``critic_lr``, ``critic_weight_decay``, ``tau``, ``optimizer``,
            ``compile``.

    Raises:
        TypeError: If the loss is another learner's.
        ValueError: If an argument is out of its range.

    Examples:
        >>> from torchrl_mpfa import make_actor, make_critic, make_td3_loss
        >>> loss = make_td3_loss(make_actor(24, 2), make_critic(24, 2), bounds=(-1.0, 1.0))
        >>> TD3Learner(loss).policy_delay
        2
    """

    loss_type = SignalTD3Loss

    def __init__(self, loss: SignalTD3Loss, *, policy_delay: int = 2, **kwargs: Any) -> None:
        super().__init__(loss, policy_delay=policy_delay, **kwargs)
