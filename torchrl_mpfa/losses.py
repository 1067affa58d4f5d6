r"""The mathematics of losses as pure functions, and the signals of TorchRL's own losses.

The functions are those of the eager and of the compiled update alike.

In the shapes ``B`` is a batch (of one or more dimensions), ``C`` the number of critics and ``A``
the size of an action.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl import objectives
from torchrl.objectives.utils import distance_loss

from torchrl_mpfa.checks import as_mask
from torchrl_mpfa.priorities import action_gradient_priority
from torchrl_mpfa.signals import ACTION_GRADIENT, TD_ERROR
from torchrl_mpfa.storages.entries import as_path

PAL = "pal"
DISTANCES = ("l1", "l2", "smooth_l1", PAL)
"""Names of the loss functions, of which all but the last are TorchRL's too."""

LEAST_NOISE = 0.05
"""Standard deviation below which a target counts as certain, in units of the reward: without noise
the errors of a network would otherwise be infinitely informative."""
POLICY_WEIGHT = "policy_weight"
BEHAVIOR_WEIGHT = "behavior_weight"
BEHAVIOR_MEAN = "behavior_mean"
BEHAVIOR_SIGMA = "behavior_sigma"


def bootstrap_target(
    reward: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    *,
    gamma: float,
    steps: Tensor | None = None,
) -> Tensor:
    r"""Target :math:`y_i = r_i + \gamma^{n_i} Q'(s_{i+n_i}, \mu'(s_{i+n_i}))`, Eq. (5) for n = 1.

    The paper leaves out that nothing follows an end, and prints the current critic's parameters
    where the target critic's are meant.

    Args:
        reward: :math:`r_i`, discounted and summed over the steps, shape ``[B]``.
        next_value: Q of the target networks at the next state, shape ``[B]``.
        terminated: True, or 1, at the end of an episode; a time limit is no end, shape ``[B]``.
        gamma: Discount.
        steps: Steps :math:`n_i` to the next state, shape ``[B]``; None: one.

    Returns:
        Targets, shape ``[B]``.

    Examples:
        >>> end = torch.tensor([False, True])
        >>> bootstrap_target(torch.ones(2), torch.ones(2), end, gamma=0.5).tolist()
        [1.5, 1.0]
        >>> three = torch.tensor([3, 3])
        >>> bootstrap_target(torch.ones(2), torch.ones(2), end, gamma=0.5, steps=three).tolist()
        [1.125, 1.0]
    """
    discount = gamma if steps is None else gamma**steps
    # Of integers ~ would turn over the bits.
    return reward + discount * next_value * ~as_mask("'terminated' of the next step", terminated)


def target_of(
    batch: TensorDictBase, next_value: Tensor, *, gamma: float, reward_scale: float = 1.0
) -> Tensor:
    """Compute the targets of a batch (Eq. 5), ``[B]``; of several steps if it has their number."""
    after, steps = batch["next"], batch.get("steps_to_next_obs", None)
    return bootstrap_target(
        (after["reward"] * reward_scale).reshape(next_value.shape),
        next_value,
        after["terminated"].reshape(next_value.shape),
        gamma=gamma,
        steps=None if steps is None else steps.reshape(next_value.shape),
    )


def smoothing_noise(action: Tensor, *, deviation: float, limit: float) -> Tensor:
    r"""Sample TD3's noise for actions ``[B, A]``, :math:`\mathrm{clip}(N(0, \sigma), -c, c)`."""
    return torch.randn_like(action).mul_(deviation).clamp_(-limit, limit)


def soft_value(values: Tensor, log_density: Tensor, *, alpha: float | Tensor) -> Tensor:
    r"""Value in SAC's target and actor's loss, :math:`\min_k Q_k(s, a) - \alpha \ln \pi(a | s)`."""
    return values.amin(0) - alpha * log_density


def distance(
    value: Tensor, target: Tensor, loss_function: str, *, unit: float = 1.0, pal_alpha: float = 0.4
) -> Tensor:
    """Distance of value and target, ``[C, B]`` or ``[B]``, one of :data:`DISTANCES`.

    ``"l2"`` is Eq. (4), ``"smooth_l1"`` the Huber loss of LAP. This and PAL bend at an error of
    ``unit``: the factor of the rewards in a loss that scales them, so that they bend at an error
    of one in units of the environment's reward.
    """
    if loss_function not in DISTANCES:
        raise ValueError(f"loss_function must be one of {DISTANCES}, got {loss_function!r}")
    if loss_function == PAL:
        return pal_distance((target - value) / unit, alpha=pal_alpha) * unit**2
    if loss_function == "smooth_l1":
        error = (target - value) / unit
        bent = torch.nn.functional.huber_loss(error, torch.zeros_like(error), reduction="none")
        return bent * unit**2
    return distance_loss(value, target, loss_function)


def pal_distance(error: Tensor, *, alpha: float = 0.4) -> Tensor:
    r"""Loss whose expected gradient under uniform sampling equals that of LAP.

    .. math::

        \frac{1}{\lambda} \begin{cases} \tfrac12 \delta^2 & |\delta| \le 1 \\
        \frac{|\delta|^{1 + \alpha}}{1 + \alpha} & \text{else} \end{cases} \qquad
        \lambda = \frac1B \sum_j \max(|\delta_j|, 1)^\alpha

    with the largest error of several critics in :math:`\lambda`. Fujimoto et al. (2020),
    https://arxiv.org/abs/2007.06049.
    """
    size = error.abs()
    # A power with a fractional exponent has no finite slope at zero, where it is not wanted.
    far = size.clamp_min(1.0).pow(1.0 + alpha) / (1.0 + alpha)
    loss = torch.where(size <= 1.0, 0.5 * size.square(), far)
    largest = size.detach() if error.ndim == 1 else size.detach().amax(0)
    return loss / largest.clamp_min(1.0).pow(alpha).mean()


def quantile_loss(quantiles: Tensor, target: Tensor) -> Tensor:
    r"""Loss of quantile regression, :math:`\frac1N \sum_k u_k (\tau_k - 1[u_k < 0])`.

    With :math:`u_k = y - \theta_k` and :math:`\tau_k = (k - \frac12) / N`, Dabney et al. (2018),
    https://arxiv.org/abs/1710.10044; from ``[B, N]`` and ``[B]`` to ``[B]``.
    """
    count = quantiles.shape[-1]
    middle = (torch.arange(count, device=quantiles.device) + 0.5) / count
    error = target.unsqueeze(-1) - quantiles
    return torch.maximum(middle * error, (middle - 1.0) * error).mean(-1)


def saturation(preactivation: Tensor, *, limit: float) -> Tensor:
    r"""Depth of actions in the flat ends of the tanh, the mean of :math:`\max(0, |u| - l)^2`."""
    return (preactivation.abs() - limit).clamp_min(0).square().mean()


def read_choices(action: Tensor, count: int, batch: TensorDictBase) -> Tensor:
    """Read the numbers, ``[B]``, of actions among ``K``: one-hot, or numbers ``[B]`` or ``[B, 1]``.

    Examples:
        >>> from tensordict import TensorDict
        >>> batch = TensorDict({}, [2])
        >>> read_choices(torch.eye(3)[[2, 0]], 3, batch).tolist()
        [2, 0]
        >>> read_choices(torch.tensor([[2], [0]]), 3, batch).tolist()
        [2, 0]
    """
    form = tuple(action.shape[batch.ndim :])
    if form == (count,):
        # One number is not zero, and it is one.
        if bool((action.count_nonzero(-1) == 1).all() & (action.sum(-1) == 1).all()):
            return action.float().argmax(-1)
    elif form in ((), (1,)) and action.dtype is not torch.bool:
        number = action.reshape(batch.shape)
        if bool(((number >= 0) & (number < count) & (number == number.long())).all()):
            return number.long()
    fits = form in ((count,), (), (1,))
    numbers = f": {action.reshape(-1)[: 2 * count].tolist()}" if fits else ""
    raise ValueError(
        f"action must be one-hot among {count}, shape {[*batch.shape, count]}, or the number of "
        f"one, shape {[*batch.shape, 1]}, got {action.dtype} of shape {[*action.shape]}{numbers}"
    )


def trusted_loss(loss: Tensor, action: Tensor, batch: TensorDictBase) -> Tensor:
    r"""Compute the actor's loss with the weights of ReF-ER, if a batch has them, shape ``[B]``.

    .. math::

        w_i L_i + v_i \sum_a \frac{(a_i - \mu_i)^2}{2 \sigma_i^2}

    The second term holds the actor near the behavior: the divergence of two Gaussians of one width,
    around the actor's action and around the behavior's mean.
    """
    if batch.get(POLICY_WEIGHT, None) is None:
        return loss
    distance = ((action - batch[BEHAVIOR_MEAN]) / batch[BEHAVIOR_SIGMA]).square().sum(-1) / 2
    held: Tensor = batch[BEHAVIOR_WEIGHT].reshape(-1) * distance
    return batch[POLICY_WEIGHT].reshape(-1) * loss + held


# The signals of TorchRL's own losses.

_SQUARED = (
    *(objectives.DDPGLoss, objectives.TD3Loss, objectives.TD3BCLoss, objectives.REDQLoss),
    *(objectives.IQLLoss, objectives.CQLLoss, objectives.DQNLoss, objectives.DiscreteCQLLoss),
)
"""Losses that write the square of the TD error."""
_ABSOLUTE = (
    *(objectives.SACLoss, objectives.CrossQLoss, objectives.DiscreteSACLoss),
    objectives.DistributionalDQNLoss,
)
"""Losses that write the absolute TD error; the distributional one a cross entropy in its place."""
SUPPORTED = (*_SQUARED, *_ABSOLUTE)


def write_signals(
    batch: TensorDictBase, loss: objectives.LossModule, *, order: float = 2.0
) -> None:
    r"""Write the signals of Eqs. (13)-(14) in a batch that one of TorchRL's losses was called with.

    The TD error is the largest of the critics, as TorchRL writes it. The slope is that of the first
    critic in its evaluation mode, of quantiles that of their mean, of an agent that of its own
    value. It takes a forward and a backward pass of its own, one for each agent: call this before
    the step of the optimizer, by which the critic would be another one. Where the loss is compiled,
    call this outside of what is compiled.

    Args:
        batch: Transitions, batch size ``[B]``, that ``loss(batch)`` was called with; gets
            ``("signals", "td_error")`` and ``("signals", "action_gradient")``, each ``[B]``; of
            ``N`` agents ``[B, N]``.
        loss: ``DDPGLoss``, ``TD3Loss``, ``TD3BCLoss``, ``SACLoss``, ``REDQLoss``, ``CrossQLoss``,
            ``IQLLoss``, ``CQLLoss`` or ``TQCLoss``; or ``DQNLoss``, ``DistributionalDQNLoss``,
            ``DiscreteSACLoss``, ``DiscreteIQLLoss`` or ``DiscreteCQLLoss``, which have a TD error
            alone.
        order: Order of the norm in Eq. (14).

    Raises:
        KeyError: If the loss was not called with the batch.
        TypeError: If the loss is another one.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import DDPGLoss, SoftUpdate
        >>> from torchrl_mpfa import make_actor, make_critic
        >>> loss = DDPGLoss(make_actor(24, 2), make_critic(24, 2))
        >>> targets = SoftUpdate(loss, tau=0.01)
        >>> end = torch.zeros(8, 1, dtype=torch.bool)
        >>> after = {"observation": torch.rand(8, 24), "reward": torch.rand(8, 1)}
        >>> after |= {"done": end, "terminated": end}
        >>> rows = {"observation": torch.rand(8, 24), "action": torch.rand(8, 2), "next": after}
        >>> batch = TensorDict(rows, [8])
        >>> _ = loss(batch)
        >>> write_signals(batch, loss)
        >>> sorted(batch["signals"].keys())
        ['action_gradient', 'td_error']
    """
    loss = getattr(loss, "_orig_mod", loss)  # Of a compiled one.
    if not isinstance(loss, SUPPORTED):
        raise TypeError(
            f"loss must be one of TorchRL's with a critic of actions, such as DDPGLoss, got "
            f"{type(loss).__name__}: write batch['signals', 'td_error'] yourself"
        )
    key = loss.tensor_keys.priority
    error = batch.get(key, None)
    if error is None:
        raise KeyError(
            f"{key!r} is missing in the batch: call loss(batch) first. A part of a loss, such as "
            "value_loss of TD3Loss, may return the error and not write it"
        )
    error = error.detach().reshape(len(batch), -1).squeeze(1)
    # SAC with a network of state values writes the square, too.
    squared = isinstance(loss, _SQUARED) or (
        isinstance(loss, objectives.SACLoss) and "loss_value" in loss.out_keys
    )
    batch.set(TD_ERROR.key, error.sqrt() if squared else error.abs())
    if hasattr(loss.tensor_keys, "state_action_value") and not isinstance(
        loss, objectives.DiscreteIQLLoss
    ):
        with torch.inference_mode(False):
            slope = _slope(*_value_of_action(batch, loss), batch.ndim)
        batch.set(ACTION_GRADIENT.key, action_gradient_priority(slope, order=order))


def _slope(value: Tensor, action: Tensor, lead: int) -> Tensor:
    """Return the slope of each transition's value, and of each agent's own, as the actions."""
    agents = action.shape[lead:-1].numel()
    if agents == 1 or value.shape != action.shape[:-1]:
        # That of the sum: no transition enters another one's value.
        return torch.autograd.grad(value.sum(), action)[0]
    # A critic may see the actions of all agents, whose values would cancel in a sum.
    values, slope = value.flatten(lead), torch.empty_like(action)
    for agent in range(agents):
        (of_all,) = torch.autograd.grad(values[..., agent].sum(), action, retain_graph=True)
        slope.flatten(lead, -2)[..., agent, :] = of_all.flatten(lead, -2)[..., agent, :]
    return slope


def _value_of_action(batch: TensorDictBase, loss: Any) -> tuple[Tensor, Tensor]:
    """Return Q of the stored actions by the first critic, ``[B]``, and the actions ``[B, A]``.

    Of ``N`` agents ``[B, N]`` and ``[B, N, A]``.
    """
    name = "value_network" if isinstance(loss, objectives.DDPGLoss) else "qvalue_network"
    critic, weights = getattr(loss, name), getattr(loss, f"{name}_params")
    if name == "qvalue_network" and weights.batch_dims:  # A single critic is not stacked.
        weights = weights[0]
    keys = loss.tensor_keys
    # TorchRL's DDPG has no name for the action.
    key = getattr(keys, "action", None) or _action_key(critic, loss.actor_network)
    inputs = batch.select(*critic.in_keys).detach()
    if any(entry.is_inference() for entry in inputs.values(True, True)):
        inputs = inputs.clone()  # Gradients need others.
    action = inputs[key].clone().requires_grad_()
    # Batch normalization counts, and dropout samples, in training alone.
    in_training = [module for module in critic.modules() if module.training]
    critic.eval()
    with torch.enable_grad(), weights.detach().to_module(critic):
        value: Tensor = critic(inputs.set(key, action))[keys.state_action_value]
    for module in in_training:
        module.training = True
    return value.mean(-1) if value.ndim == action.ndim else value, action


def _action_key(critic: Any, actor: Any) -> NestedKey:
    """Return the entry that an actor writes and its critic reads, the action.

    Raises:
        KeyError: If there is none, or several and none is called ``"action"``.
    """
    read: list[NestedKey] = list(critic.in_keys)
    shared = [key for key in read if key in actor.out_keys]
    named = [key for key in shared or read if as_path(key)[-1] == "action"]
    if len(named or shared) != 1:
        raise KeyError(
            f"the critic must read one action of the actor, got {shared} of what it reads, {read}: "
            "name the action 'action', or write batch['signals', 'action_gradient'] yourself"
        )
    return (named or shared)[0]
