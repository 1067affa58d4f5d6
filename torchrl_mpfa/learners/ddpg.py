"""DDPG: actor and critic move at every update, or the actor less often."""

from __future__ import annotations

from torchrl_mpfa.learners.base import ActorCriticLearner
from torchrl_mpfa.losses import SignalDDPGLoss


class DDPGLearner(ActorCriticLearner):
    r"""DDPG with target networks, Eqs. (4)-(7), and the actor's sampled policy gradient.

    More of each option: :class:`~torchrl_mpfa.learners.ActorCriticLearner`.

    Args:
        loss: A :class:`~torchrl_mpfa.SignalDDPGLoss` with both networks in it.
        actor_lr: Learning rate of the actor, Table 1.
        critic_lr: Learning rate of the critic, Table 1.
        critic_weight_decay: L2 decay of the critic's weights.
        tau: Share of the networks in the target networks' step, Table 1.
        optimizer: ``"adam"`` or ``"radam"``.
        policy_delay: Updates of the critic for one of the actor and of the targets. Eqs. (4)-(7)
            have 1; 2 is TD3's (Fujimoto et al. 2018), and steadies a single critic.
        compile: Whether the losses are one compiled program, or the arguments of
            ``torch.compile``.

    Raises:
        TypeError: If the loss is another learner's.
        ValueError: If an argument is out of its range.

    Examples:
        >>> from torchrl_mpfa import make_actor, make_critic, make_ddpg_loss
        >>> learner = DDPGLearner(make_ddpg_loss(make_actor(24, 2), make_critic(24, 2)))
        >>> learner.policy.out_keys
        ['preactivation', 'action']
    """

    loss_type = SignalDDPGLoss
