"""DQN and Q learning: the policy is the greatest of the values of a few actions."""

from __future__ import annotations

import copy
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_mpfa.checks import ABOVE_ZERO, NOT_NEGATIVE, POSITIVE, SHARE, check
from torchrl_mpfa.learners.base import OptimizedLearner, OptimizerName
from torchrl_mpfa.learners.states import naming, refuse_unfinished
from torchrl_mpfa.losses.dqn import SignalDQNLoss
from torchrl_mpfa.losses.functional import bootstrap_target, read_choices
from torchrl_mpfa.networks import DirectModule
from torchrl_mpfa.networks.values import ValueTable
from torchrl_mpfa.saved import Entry, check_entries, count
from torchrl_mpfa.selection import SampledBatch
from torchrl_mpfa.signals import TD_ERROR

_ONE_NETWORK = (
    "a draw for the {trains} alone, or with the loss function {loss_function!r}, needs actor and "
    "critic: {name} has one network for both"
)


def _whole_batch(draw: SampledBatch | TensorDictBase, name: str) -> TensorDictBase:
    """The sampled batch, which must be for actor and critic alike."""
    if not isinstance(draw, SampledBatch):
        return draw
    if draw.trains != "both" or draw.loss_function is not None:
        raise ValueError(
            _ONE_NETWORK.format(trains=draw.trains, loss_function=draw.loss_function, name=name)
        )
    return draw.batch


class DQNLearner(OptimizedLearner):
    r"""DQN (Mnih et al. 2015, https://doi.org/10.1038/nature14236), double by default.

    Args:
        loss: The loss with its network in it.
        lr: Learning rate.
        weight_decay: L2 decay of the weights.
        tau: Share of the network in the target network's step.
        optimizer: ``"adam"`` or ``"radam"``.

    Raises:
        TypeError: If the loss is another learner's, or its network no :class:`DirectModule`.
        ValueError: If an argument is out of its range.

    Examples:
        >>> from torchrl_mpfa import SignalDQNLoss, make_value_network
        >>> learner = DQNLearner(SignalDQNLoss(make_value_network(24, 7)))
        >>> learner.policy.outputs({"observation": torch.rand(5, 24)})["action"].sum(-1).tolist()
        [1, 1, 1, 1, 1]
    """

    def __init__(
        self,
        loss: SignalDQNLoss,
        *,
        lr: float = 1e-4,
        weight_decay: float = 0.0,
        tau: float = 0.01,
        optimizer: OptimizerName = "adam",
    ) -> None:
        if not isinstance(loss, SignalDQNLoss):
            raise TypeError(
                f"loss of a DQNLearner must be a SignalDQNLoss, got {type(loss).__name__}"
            )
        check(POSITIVE, lr=lr)
        check(NOT_NEGATIVE, weight_decay=weight_decay)
        check(ABOVE_ZERO, tau=tau)
        network = loss.value_network
        if not isinstance(network, DirectModule):
            raise TypeError(f"network must be a DirectModule, got {type(network).__name__}")
        parameters = list(loss.value_network_params.values(True, True))
        groups = [{"params": parameters, "lr": lr, "weight_decay": weight_decay}]
        super().__init__(loss, groups, optimizer, tau)
        # A copy that holds the loss's own tensors, not copies of them.
        self.policy: DirectModule = copy.deepcopy(network)
        loss.value_network_params.to_module(self.policy)

    def update(self, draw: SampledBatch | TensorDictBase) -> dict[str, Tensor]:
        """One step of the network and of the target network.

        Args:
            draw: What is learned from; a batch of size ``[B]`` stands for
                ``SampledBatch(batch)``. Gets the signal of Eq. (13).

        Returns:
            Detached values for the log.

        Raises:
            KeyError: If the batch lacks an entry.
            ValueError: If the loss is not finite, or the draw is for an actor or critic alone;
                nothing is changed then.
        """
        batch = _whole_batch(draw, type(self).__name__)
        self.optimizer.zero_grad(set_to_none=True)
        with naming(batch):
            loss, log = self.loss.losses(batch)
        log["loss_value"] = loss
        refuse_unfinished(log, batch)
        loss.backward()
        self.optimizer.step()
        self.targets.step()
        self.updates += 1
        return {key: value.detach() for key, value in log.items()}


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
        importance: Whether importance weights, where a batch has them, scale the TD errors.

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
        check(ABOVE_ZERO, lr=lr)
        check(SHARE, gamma=gamma)
        self.policy, self.gamma, self.importance = policy, gamma, importance
        self._rate = self._first_rate = lr
        self.updates = 0
        """Updates made."""

    @property
    def table(self) -> Tensor:
        """Values, shape ``[cells, K]``."""
        found: Tensor = self.policy.module.table
        return found

    @torch.no_grad()
    def update(self, draw: SampledBatch | TensorDictBase) -> dict[str, Tensor]:
        """Move the entries that the transitions of a batch belong to.

        Args:
            draw: As in :meth:`DQNLearner.update`; actions are one-hot, ``[B, K]``, or numbers.

        Returns:
            Values for the log.

        Raises:
            KeyError: If the batch lacks an entry.
            ValueError: If a number is not finite, the actions have neither form, or the draw is
                for an actor or critic alone; nothing is changed then.
        """
        batch = _whole_batch(draw, type(self).__name__)
        cell_of, table = self.policy.module.cell_of, self.table
        action = read_choices(batch["action"], table.shape[1], batch)
        entry = cell_of(batch["observation"]) * table.shape[1] + action
        ahead = table[cell_of(batch["next", "observation"])].amax(-1)
        steps = batch.get("steps_to_next_obs", None)
        target = bootstrap_target(
            batch["next", "reward"].squeeze(-1),
            ahead,
            batch["next", "terminated"].squeeze(-1),
            gamma=self.gamma,
            steps=None if steps is None else steps.reshape(-1),
        )
        td_error = target - table.view(-1)[entry]
        squared, value = td_error.square(), table.view(-1)[entry]
        log = {"loss_value": squared.mean(), "td_error": squared, "pred_value": value}
        step = td_error
        if self.importance and "priority_weight" in batch.keys():  # noqa: SIM118
            step = td_error * batch["priority_weight"].reshape(-1)
        refuse_unfinished({**log, "loss_step": step}, batch)
        batch.set(TD_ERROR.key, td_error.abs())
        total = torch.zeros(table.numel()).index_add_(0, entry, step)
        count = torch.bincount(entry, minlength=table.numel()).clamp_min(1)
        table.view(-1).add_(total / count, alpha=self._rate)
        self.updates += 1
        return log

    def end_episode(self) -> None:
        """Nothing changes."""

    def anneal(self, factor: float) -> None:
        """Set the learning rate to a fraction of what the constructor was given.

        Args:
            factor: The fraction, in [0, 1].

        Raises:
            ValueError: If ``factor`` is outside.
        """
        check(SHARE, factor=factor)
        self._rate = self._first_rate * factor

    def state_dict(self) -> dict[str, Any]:
        """The table and the count."""
        return {"loss": {"table": self.table.clone()}, "updates": self.updates}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave.

        Args:
            state_dict: The state of a learner with a table of the same size.

        Raises:
            ValueError: If it is not; nothing is changed then.
        """
        check_entries("learner", state_dict, [Entry("loss"), count("updates")], missing=ValueError)
        table = Entry("table", torch.isfinite, "finite", self.table.dtype, tuple(self.table.shape))
        check_entries("loss", state_dict["loss"], [table], missing=ValueError)
        self.table.copy_(state_dict["loss"]["table"])
        self.updates = state_dict["updates"]
