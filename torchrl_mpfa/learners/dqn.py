"""DQN and Q learning: the policy is the greatest of the values of a few actions."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_mpfa.checks import ABOVE_ZERO, NOT_NEGATIVE, POSITIVE, SHARE, check
from torchrl_mpfa.learners.checks import check_alike, check_losses
from torchrl_mpfa.learners.optimized import IMPORTANCE, OptimizedLearner, OptimizerName
from torchrl_mpfa.losses import distance, read_choices, target_of
from torchrl_mpfa.networks import DirectModule
from torchrl_mpfa.networks.values import ValueTable
from torchrl_mpfa.priorities import td_error_priority
from torchrl_mpfa.selection import SampledBatch, Trains, as_sampled
from torchrl_mpfa.signals import ACTION_GRADIENT, TD_ERROR

_DISTANCES = ("l1", "l2", "smooth_l1")


def _whole_batch(sampled: SampledBatch | TensorDictBase, learner: object) -> TensorDictBase:
    """Return the sampled batch, which must be for actor and critic alike."""
    sampled = as_sampled(sampled)
    if sampled.trains != "both" or sampled.loss_function is not None:
        raise ValueError(
            f"a batch for the {sampled.trains} alone, or with the loss function "
            f"{sampled.loss_function!r}, needs actor and critic: {type(learner).__name__} has one "
            "network for both"
        )
    return sampled.batch


class DQN(OptimizedLearner):
    r"""DQN (Mnih et al. 2015, https://doi.org/10.1038/nature14236), double by default.

    A batch gets ``("signals", "td_error")`` :math:`= |\delta_i|`, shape ``[B]``. There is no signal
    of Eq. (14): a choice among actions has no slope. The loss is Eq. (11),
    :math:`\frac{1}{N} \sum_i w_i (y_i - Q(s_i, a_i))^2`.

    Args:
        network: From observations to ``"action_value"`` and a one-hot ``"action"``, such as
            :func:`~torchrl_mpfa.make_value_network` gives. It is held, not copied.
        signals: ``["td_error"]``, or none.
        importance: ``"critic"``: weights divided by the batch size (Eq. 11); ``"torchrl"``: by
            their sum; ``"none"``.
        reward_scale: Factor of the rewards in the loss; the signal is divided by it again.
        loss_function: ``"l2"``, ``"l1"`` or ``"smooth_l1"``, which bends at an error of one in
            units of the environment's reward.
        double: True to take the next action from the network, and not from the target network
            (van Hasselt et al. 2016, https://arxiv.org/abs/1509.06461).
        gamma: Discount, in [0, 1].
        lr: Learning rate.
        weight_decay: L2 decay of the weights.
        tau: Share of the network in the target network's step.
        optimizer: ``"adam"`` or ``"radam"``.

    Raises:
        TypeError: If the network is no :class:`DirectModule`.
        ValueError: If an argument is out of its range.

    Examples:
        >>> from torchrl_mpfa import make_value_network
        >>> learner = DQN(make_value_network(24, 7))
        >>> learner.policy.outputs({"observation": torch.rand(5, 24)})["action"].sum(-1).tolist()
        [1, 1, 1, 1, 1]
    """

    def __init__(
        self,
        network: DirectModule,
        *,
        signals: Sequence[str] = (TD_ERROR.name,),
        importance: str = "critic",
        reward_scale: float = 1.0,
        loss_function: str = "l2",
        double: bool = True,
        gamma: float = 0.99,
        lr: float = 1e-4,
        weight_decay: float = 0.0,
        tau: float = 0.01,
        optimizer: OptimizerName = "adam",
    ) -> None:
        if not isinstance(network, DirectModule):
            raise TypeError(f"network must be a DirectModule, got {type(network).__name__}")
        for name in signals:
            if name == ACTION_GRADIENT.name:
                raise ValueError(
                    f"signals must not have {name!r}: values of separate actions have no slope. "
                    "Leave it out, as with signals=['reward', 'td_error']"
                )
            if name != TD_ERROR.name:
                raise ValueError(f"signals must be among ['td_error'], got {name!r}")
        if loss_function not in _DISTANCES:
            raise ValueError(f"loss_function must be one of {_DISTANCES}, got {loss_function!r}")
        self.signals, self.loss_function, self.double = tuple(signals), loss_function, double
        self.importance = check(IMPORTANCE, importance=importance)
        self.reward_scale, lr = check(POSITIVE, reward_scale=reward_scale, lr=lr)
        self.gamma = check(SHARE, gamma=gamma)
        decay = check(NOT_NEGATIVE, weight_decay=weight_decay)
        groups = [{"params": [*network.parameters()], "lr": lr, "weight_decay": decay}]
        target = copy.deepcopy(network).requires_grad_(False)
        networks, targets = nn.ModuleDict({"value": network}), nn.ModuleDict({"value": target})
        super().__init__(networks, targets, groups, optimizer, tau)
        self.policy: DirectModule = network

    def update(self, sampled: SampledBatch | TensorDictBase) -> dict[str, Tensor]:
        """Step the network and the target network.

        Args:
            sampled: The batch; one of size ``[B]`` stands for ``SampledBatch(batch)``. It gets the
                signal of Eq. (13). Actions are one-hot, ``[B, K]``, or numbers, ``[B, 1]``.

        Returns:
            Detached values for the log.

        Raises:
            KeyError: If the batch lacks an entry.
            ValueError: If the loss is not finite, the actions have neither form, or the batch is
                for an actor or critic alone; nothing is changed then.
        """
        return super().update(_whole_batch(sampled, self))

    def _differentiate(
        self, batch: TensorDictBase, trains: Trains, loss_function: str | None
    ) -> dict[str, Tensor]:
        online, target = self.policy, self.targets["value"]
        states, after = self._states_of(batch), self._states_of(batch["next"])
        values = online.outputs(states)["action_value"]
        number = read_choices(batch["action"], values.shape[-1], batch)
        value = values.gather(-1, number.unsqueeze(-1)).squeeze(-1)
        with torch.no_grad():
            choice = (online if self.double else target).outputs(after)["action"]
            ahead = (target.outputs(after)["action_value"] * choice).sum(-1)
            aim = target_of(batch, ahead, gamma=self.gamma, reward_scale=self.reward_scale)
        losses = distance(value, aim, self.loss_function, unit=self.reward_scale)  # Eq. (4)
        weight = batch.get("priority_weight", None)
        if weight is not None and self.importance != "none":
            weight = weight.reshape(-1)
            losses = losses * weight / (weight.mean() if self.importance == "torchrl" else 1.0)
        loss = losses.mean()  # Eq. (11)
        loss.backward()
        error = (aim - value).detach()
        if self.signals:
            batch.set(TD_ERROR.key, td_error_priority(error) / self.reward_scale)  # Eq. (13)
        return {"loss_value": loss.detach(), "td_error": error.square()}

    def _states_of(self, source: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Read the inputs of the network, without gradients."""
        return {key: source[key].detach() for key in self.policy.in_keys}


class TabularQLearner:
    r"""Q learning (Watkins 1989) of a table, from batches of any replay.

    Each transition of a batch has a TD error :math:`\delta_i = r_i + \gamma \max_a Q(s'_i, a) -
    Q(s_i, a_i)`, all of them by the table before the update. An entry of the table moves by the
    learning rate times the mean of :math:`w_i \delta_i` over those transitions of the batch that
    are its own. With a batch of one, the newest, this is Q learning as it was first described:
    ``make_replay("cer", batch_size=1)``.

    Args:
        policy: The table with its cells, out of :func:`~torchrl_mpfa.networks.make_value_table`.
        lr: Learning rate.
        gamma: Discount, in [0, 1].
        importance: True to scale TD errors by the importance weights of a batch, if it has them.

    Raises:
        TypeError: If the policy is no table.
        ValueError: If an argument is out of its range.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_mpfa.networks import make_value_table
        >>> policy = make_value_table(lambda seen: (seen[..., 0] > 0.5).long(), 2, 3)
        >>> learner = TabularQLearner(policy, lr=0.5)
        >>> end = torch.ones(1, 1, dtype=torch.bool)
        >>> after = {"observation": torch.ones(1, 1), "reward": torch.ones(1, 1), "terminated": end}
        >>> choice = torch.tensor([[0, 1, 0]])
        >>> rows = {"observation": torch.ones(1, 1), "action": choice, "next": after}
        >>> _ = learner.update(TensorDict(rows, [1]))
        >>> policy.module.table.tolist()
        [[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]]
    """

    def __init__(
        self,
        policy: DirectModule,
        *,
        lr: float = 0.2,
        gamma: float = 0.99,
        importance: bool = True,
    ) -> None:
        if not isinstance(getattr(policy, "module", None), ValueTable):
            raise TypeError(f"policy must be one of make_value_table, got {type(policy).__name__}")
        self._rate = self._first_rate = check(ABOVE_ZERO, lr=lr)
        self.gamma = check(SHARE, gamma=gamma)
        self.policy, self.importance = policy, importance
        self.updates = 0
        """Training steps taken."""

    @property
    def table(self) -> Tensor:
        """Values of all cells, shape ``[cells, K]``."""
        found: Tensor = self.policy.module.table
        return found

    @torch.no_grad()
    def update(self, sampled: SampledBatch | TensorDictBase) -> dict[str, Tensor]:
        """Move the entries that the transitions of a batch belong to.

        Args:
            sampled: As in :meth:`DQN.update`; actions are one-hot, ``[B, K]``, or numbers.

        Returns:
            Values for the log.

        Raises:
            KeyError: If the batch lacks an entry.
            ValueError: If a number is not finite, the actions have neither form, or the batch is
                for an actor or critic alone; nothing is changed then.
        """
        batch = _whole_batch(sampled, self)
        cell_of, table = self.policy.module.cell_of, self.table
        action = read_choices(batch["action"], table.shape[1], batch)
        entry = cell_of(batch["observation"]) * table.shape[1] + action
        ahead = table[cell_of(batch["next", "observation"])].amax(-1)
        target = target_of(batch, ahead, gamma=self.gamma)
        td_error = target - table.view(-1)[entry]
        squared, value = td_error.square(), table.view(-1)[entry]
        log = {"loss_value": squared.mean(), "td_error": squared, "pred_value": value}
        step = td_error
        if self.importance and "priority_weight" in batch.keys():  # noqa: SIM118
            step = td_error * batch["priority_weight"].reshape(-1)
        check_losses({**log, "loss_step": step}, batch)
        batch.set(TD_ERROR.key, td_error.abs())
        total = torch.zeros(table.numel()).index_add_(0, entry, step)
        count = torch.bincount(entry, minlength=table.numel()).clamp_min(1)
        table.view(-1).add_(total / count, alpha=self._rate)
        self.updates += 1
        return log

    def end_episode(self) -> None:
        """Change nothing."""

    def anneal(self, factor: float) -> None:
        """Set the learning rate to a fraction of the constructor's.

        Args:
            factor: The fraction, in [0, 1].

        Raises:
            ValueError: If ``factor`` is outside.
        """
        self._rate = self._first_rate * check(SHARE, factor=factor)

    def state_dict(self) -> dict[str, Any]:
        """Return the table and the count."""
        return {"networks": {"table": self.table.clone()}, "updates": self.updates}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state from :meth:`state_dict`.

        Args:
            state_dict: The state of a learner with a table of the same size.

        Raises:
            ValueError: If its table is of another size, or not finite; nothing is changed then.
        """
        check_alike("learner", state_dict, self.state_dict())
        self.table.copy_(state_dict["networks"]["table"])
        self.updates = state_dict["updates"]
