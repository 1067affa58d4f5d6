r"""Curiosity: a bonus for transitions whose outcome the robot cannot predict yet.

Intrinsic curiosity module of Pathak et al. (2017), https://arxiv.org/abs/1705.05363, which Li et
al. (2021), https://doi.org/10.1155/2021/5169460, add to DDPG with RAdam and PER. Features
:math:`\phi` of observations are learned from which the action can be inferred, given those before
and after it; the bonus is the error of predicting the latter from the former and the action.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_mpfa import ActorCritic
from torchrl_mpfa.checks import POSITIVE, SHARE, Rule, check, check_counts
from torchrl_mpfa.learners.optimized import check_losses
from torchrl_mpfa.methods import Prioritized
from torchrl_mpfa.methods.base import one_of, within

OPTIMIZER: Rule = (lambda name: name in ("radam", "adam"), "'radam' or 'adam'")


def intrinsic_reward(foreseen: Tensor, features: Tensor, *, scale: float) -> Tensor:
    r"""Compute the bonus :math:`\tfrac{\eta}{2} \lVert \hat\phi' - \phi' \rVert^2`.

    Args:
        foreseen: Features that the forward model predicts, shape ``[B, F]``.
        features: Features of the next observation, shape ``[B, F]``.
        scale: :math:`\eta`.

    Returns:
        Bonuses, shape ``[B]``.

    Examples:
        >>> intrinsic_reward(torch.zeros(1, 2), torch.ones(1, 2), scale=0.5).tolist()
        [0.5]
    """
    return 0.5 * scale * (foreseen - features).square().sum(-1)


def _network(*sizes: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


class Curiosity(nn.Module):
    r"""Adds the bonus to the rewards of a sampled batch, and trains its models on it.

    The bonus is computed whenever a transition is sampled, so that it fades as the models
    learn; the buffer keeps the reward of the environment. Call it on a batch before the learner:
    ``("next", "reward")`` gets the bonus on top, the reward alone stays at
    ``("next", "extrinsic_reward")``, and the bonus is at ``("next", "intrinsic_reward")``. The
    losses of the models are :math:`(1 - b) L_{inverse} + b L_{forward}`.

    Args:
        observation_size: ``O``.
        action_size: ``A``.
        features: Size ``F`` of the features.
        width: Units of the hidden layers.
        scale: :math:`\eta` of the bonus.
        forward_share: :math:`b`.
        lr: Learning rate of the models, by default ten times the actor's in Table 1, as in the
            public code of the module.
        reward_key: Key of the reward within ``"next"``.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> from tensordict import TensorDict
        >>> curiosity = Curiosity(24, 2)
        >>> batch = TensorDict(
        ...     {
        ...         "observation": torch.rand(8, 24),
        ...         "action": torch.rand(8, 2),
        ...         "next": {"observation": torch.rand(8, 24), "reward": torch.zeros(8, 1)},
        ...     },
        ...     [8],
        ... )
        >>> sorted(curiosity(batch))
        ['forward_loss', 'intrinsic_reward', 'inverse_loss']
        >>> bool((batch["next", "reward"] > 0).all())
        True
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        *,
        features: int = 32,
        width: int = 64,
        scale: float = 0.01,
        forward_share: float = 0.2,
        lr: float = 1e-3,
        reward_key: NestedKey = "reward",
    ) -> None:
        super().__init__()
        check_counts(observation_size=observation_size, action_size=action_size)
        check_counts(features=features, width=width)
        self.scale, lr = check(POSITIVE, scale=scale, lr=lr)
        self.forward_share = check(SHARE, forward_share=forward_share)
        self.reward_key = reward_key
        self.encoder = _network(observation_size, width, features)
        self.inverse_model = _network(2 * features, width, action_size)
        self.forward_model = _network(features + action_size, width, features)
        self.optimizer = torch.optim.RAdam(self.parameters(), lr=lr)

    def forward(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Add the bonus to a batch, and take one step of the models.

        Args:
            batch: Transitions as a buffer gave them, batch size ``[B]``.

        Returns:
            Detached values for the log.

        Raises:
            KeyError: If the batch lacks an entry.
            ValueError: If a number of it is not finite; nothing is changed then.
        """
        action, following = batch["action"], batch["next"]
        reward = following[self.reward_key]
        before, then = self.encoder(batch["observation"]), self.encoder(following["observation"])
        inferred = self.inverse_model(torch.cat((before, then), -1))
        foreseen = self.forward_model(torch.cat((before, action), -1))
        inverse_loss = (inferred - action).square().sum(-1).mean()
        forward_loss = intrinsic_reward(foreseen, then, scale=1.0).mean()
        bonus = intrinsic_reward(foreseen, then, scale=self.scale).detach()
        bonus = bonus.reshape(reward.shape).to(reward.dtype)
        losses = {"loss_inverse": inverse_loss, "loss_forward": forward_loss}
        check_losses({"loss_reward": reward + bonus, **losses}, batch)
        self.optimizer.zero_grad()
        # The features learn from both.
        ((1.0 - self.forward_share) * inverse_loss + self.forward_share * forward_loss).backward()
        self.optimizer.step()
        following.set("extrinsic_reward", reward)
        following.set("intrinsic_reward", bonus)
        following.set(self.reward_key, reward + bonus)
        return {
            "inverse_loss": inverse_loss.detach(),
            "forward_loss": forward_loss.detach(),
            "intrinsic_reward": bonus,
        }

    def checkpoint(self) -> dict[str, Any]:
        """Return models and optimizer as tensors and plain values."""
        return {"models": self.state_dict(), "optimizer": self.optimizer.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Restore a state from :meth:`checkpoint`."""
        self.load_state_dict(state["models"])
        self.optimizer.load_state_dict(state["optimizer"])


class RAdamLearner(ActorCritic):
    """A learner whose optimizer warms up by itself (Liu et al. 2020, arXiv:1908.03265).

    Args:
        *networks: As :class:`~torchrl_mpfa.ActorCritic`.
        optimizer: ``"radam"``, or ``"adam"`` as elsewhere.
        **options: As :class:`~torchrl_mpfa.ActorCritic`.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> from torchrl_mpfa import make_actor, make_critic
        >>> type(RAdamLearner(make_actor(24, 2), make_critic(24, 2)).optimizer).__name__
        'RAdam'
    """

    def __init__(
        self, *networks: TensorDictModule, optimizer: str = "radam", **options: Any
    ) -> None:
        self._optimizer_name = check(OPTIMIZER, optimizer=optimizer)
        super().__init__(*networks, **options)

    def make_optimizer(self, groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
        """Make the optimizer of the name, which steps all tensors in one call."""
        if self._optimizer_name == "adam":
            return super().make_optimizer(groups)
        return torch.optim.RAdam(groups, foreach=True)


@dataclass
class Curious(Prioritized):
    """PER with RAdam, and a bonus for outcomes that the robot could not predict (ICM)."""

    name: str = "ddpg_radam"
    optimizer: str = one_of("radam", "adam")
    """``radam`` or ``adam``."""
    curiosity: float = within(POSITIVE, 0.01)
    """eta: factor of the bonus."""
    learner: ClassVar[str] = "benchmarks.paper.methods.ddpg_radam.RAdamLearner"
    needs_actor: ClassVar[bool] = True

    def learner_options(self) -> dict[str, Any]:
        """Return the name of the optimizer."""
        return {"optimizer": self.optimizer}

    def bonus(self, observation_size: int, action_size: int) -> Curiosity:
        """Make the models whose errors are the bonus."""
        return Curiosity(observation_size, action_size, scale=self.curiosity)
