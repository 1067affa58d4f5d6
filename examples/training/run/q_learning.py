"""Q learning of a table, for discrete actions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_mpfa.checks import ABOVE_ZERO, SHARE, check, check_counts
from torchrl_mpfa.learners.dqn import reject_part
from torchrl_mpfa.learners.optimized import check_form, check_losses
from torchrl_mpfa.losses import read_choices, target_of
from torchrl_mpfa.networks import DirectModule
from torchrl_mpfa.networks.deterministic import OUT_KEYS, with_best
from torchrl_mpfa.saving import check_saved_numbers
from torchrl_mpfa.selection import SampledBatch, as_sampled
from torchrl_mpfa.signals import TD_ERROR


class ValueTable(nn.Module):
    """A table with a row of values for each cell of the observations."""

    table: Tensor

    def __init__(self, cell_of: Callable[[Tensor], Tensor], cells: int, actions: int) -> None:
        super().__init__()
        self.cell_of = cell_of
        self.register_buffer("table", torch.zeros(cells, actions))

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map ``[..., O]`` to values and choice, ``[..., K]``, and its value, ``[..., 1]``."""
        return with_best(self.table[self.cell_of(observation)])


def make_value_table(cell_of: Callable[[Tensor], Tensor], cells: int, actions: int) -> DirectModule:
    """Make a table from ``"observation"`` to values of actions, zero at first, and the best one.

    Args:
        cell_of: From observations, shape ``[..., O]``, to integers in [0, cells), shape ``[...]``.
        cells: Number of rows.
        actions: Number of actions ``K``.

    Returns:
        A module for :class:`~TabularQLearner`.

    Raises:
        ValueError: If a size is not a positive integer.

    Examples:
        >>> table = make_value_table(lambda seen: (seen[..., 0] > 0).long(), 2, 3)
        >>> table.outputs({"observation": torch.rand(5, 24)})["action_value"].shape
        torch.Size([5, 3])
    """
    check_counts(cells=cells, actions=actions)
    table = ValueTable(cell_of, cells, actions)
    return DirectModule(table, in_keys=["observation"], out_keys=OUT_KEYS)


class TabularQLearner:
    r"""Q learning (Watkins 1989) of a table, from batches of any replay.

    Each transition of a batch has a TD error :math:`\delta_i = r_i + \gamma \max_a Q(s'_i, a) -
    Q(s_i, a_i)`, all of them by the table before the update. An entry of the table moves by the
    learning rate times the mean of :math:`w_i \delta_i` over those transitions of the batch that
    are its own. With a batch of one, the newest, this is Q learning as it was first described:
    ``make_replay("cer", batch_size=1)``.

    Args:
        policy: The table with its cells, out of :func:`~make_value_table`.
        lr: Learning rate.
        gamma: Discount, in [0, 1].
        importance: True to scale TD errors by the importance weights of a batch, if it has them.

    Raises:
        TypeError: If the policy is no table.
        ValueError: If an argument is out of its range.

    Examples:
        >>> from tensordict import TensorDict
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
        table: Tensor = self.policy.module.table
        return table

    @torch.no_grad()
    def update(self, sampled: SampledBatch | TensorDictBase) -> dict[str, Tensor]:
        """Move the entries that the transitions of a batch belong to.

        Args:
            sampled: The batch; actions are one-hot, ``[B, K]``, or numbers.

        Returns:
            Values for the log.

        Raises:
            KeyError: If the batch lacks an entry.
            ValueError: If a number is not finite, the actions have neither form, or the batch is
                for an actor or critic alone; nothing is changed then.
        """
        sampled = as_sampled(sampled)
        reject_part(sampled.trains, sampled.loss_function, self)
        batch = sampled.batch
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
        """Return the table and the count, or raise ``ValueError`` if a value is not finite."""
        check_saved_numbers("learner", {"table": self.table})
        return {"networks": {"table": self.table.clone()}, "updates": self.updates}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state from :meth:`state_dict`.

        Args:
            state_dict: The state of a learner with a table of the same size.

        Raises:
            ValueError: If its table is of another size, or not finite; nothing is changed then.
        """
        check_form("the saved learner", state_dict, self.state_dict())
        check_saved_numbers("learner", state_dict)
        self.table.copy_(state_dict["networks"]["table"])
        self.updates = state_dict["updates"]
