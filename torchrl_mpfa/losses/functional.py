r"""The mathematics of the losses as pure functions, of the eager and of the compiled update alike.

In the shapes ``B`` is a batch (of one or more dimensions), ``C`` the number of critics and ``A``
the size of an action.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.objectives.utils import distance_loss

PAL = "pal"
DISTANCES = ("l1", "l2", "smooth_l1", PAL)
"""Names of the loss functions, of which all but the last are for :func:`distance`."""


def bootstrap_target(
    reward: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    *,
    gamma: float | Tensor,
    steps: Tensor | None = None,
) -> Tensor:
    r"""Target :math:`y_i = r_i + \gamma^{n_i} Q'(s_{i+n_i}, \mu'(s_{i+n_i}))`, Eq. (5) for n = 1.

    The paper leaves out that nothing follows an end, and prints the current critic's parameters
    where the target critic's are meant.

    Args:
        reward: :math:`r_i`, discounted and summed over the steps, shape ``[B]``.
        next_value: Q of the target networks at the next state, shape ``[B]``.
        terminated: Whether the episode ended there, as booleans or numbers; a time limit is no
            end, shape ``[B]``.
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
    return reward + discount * next_value * ~terminated.bool()


def smoothing_noise(action: Tensor, *, deviation: float, limit: float) -> Tensor:
    r"""Noise of TD3's target, :math:`\mathrm{clip}(N(0, \sigma), -c, c)`.

    Args:
        action: Any actions, for their shape ``[B, A]``, type and device.
        deviation: :math:`\sigma`, in units of the action.
        limit: :math:`c`.

    Returns:
        Noise, shape ``[B, A]``.

    Examples:
        >>> noise = smoothing_noise(torch.zeros(100, 2), deviation=1.0, limit=0.5)
        >>> bool((noise.abs() <= 0.5).all())
        True
    """
    return torch.randn_like(action).mul_(deviation).clamp_(-limit, limit)


def smoothed_action(action: Tensor, noise: Tensor, *, low: Tensor, high: Tensor) -> Tensor:
    """Action of TD3's target, with noise and within the bounds, shape ``[B, A]``.

    Args:
        action: Of the target actor, shape ``[B, A]``.
        noise: Of :func:`smoothing_noise`, shape ``[B, A]``.
        low: Least action, shape ``[]`` or ``[A]``.
        high: Greatest action, of the same shape.

    Returns:
        Actions, shape ``[B, A]``.

    Examples:
        >>> bounds = {"low": torch.tensor(-1.0), "high": torch.tensor(1.0)}
        >>> smoothed_action(torch.tensor([[0.9]]), torch.tensor([[0.5]]), **bounds)
        tensor([[1.]])
    """
    return torch.clamp(action + noise, low, high)


def least_value(values: Tensor) -> Tensor:
    r"""Value in TD3's clipped double-Q target, :math:`\min_k Q_k`.

    Args:
        values: Of each critic, shape ``[C, B]``.

    Returns:
        The least, shape ``[B]``.

    Examples:
        >>> least_value(torch.tensor([[1.0, 4.0], [2.0, 3.0]])).tolist()
        [1.0, 3.0]
    """
    return values.amin(0)


def soft_value(values: Tensor, log_density: Tensor, *, alpha: float | Tensor) -> Tensor:
    r"""Value in SAC's target and actor's loss, :math:`\min_k Q_k(s, a) - \alpha \ln \pi(a | s)`.

    Args:
        values: Of each critic, shape ``[C, B]``.
        log_density: :math:`\ln \pi(a | s)`, shape ``[B]``.
        alpha: Temperature.

    Returns:
        Soft values, shape ``[B]``.

    Examples:
        >>> soft_value(torch.tensor([[1.0], [2.0]]), torch.tensor([-1.0]), alpha=0.5).tolist()
        [1.5]
    """
    return least_value(values) - alpha * log_density


def critic_loss(
    value: Tensor,
    target: Tensor,
    loss_function: str,
    *,
    unit: float | Tensor,
    pal_alpha: float,
) -> Tensor:
    """Loss of each transition, summed over the critics (Eq. 4).

    Args:
        value: Q of each critic, shape ``[C, B]``.
        target: Targets, shape ``[B]``.
        loss_function: As of :func:`distance`, as are the following two.
        unit: Error at which the last two bend.
        pal_alpha: Priority exponent that PAL stands for.

    Returns:
        Losses, shape ``[B]``.

    Raises:
        ValueError: If the loss function is unknown.

    Examples:
        >>> value, target = torch.zeros(2, 3), torch.ones(3)
        >>> critic_loss(value, target, "l2", unit=1.0, pal_alpha=0.4).tolist()
        [2.0, 2.0, 2.0]
    """
    target = target.expand_as(value)
    return distance(value, target, loss_function, unit=unit, pal_alpha=pal_alpha).sum(0)


def distance(
    value: Tensor,
    target: Tensor,
    loss_function: str,
    *,
    unit: float | Tensor = 1.0,
    pal_alpha: float = 0.4,
) -> Tensor:
    """Loss of each transition by the name of its distance.

    ``"l2"`` is Eq. (4) of the paper, ``"smooth_l1"`` the Huber loss of LAP, ``"pal"`` that of
    :func:`pal_distance`.

    Args:
        value: Q, shape ``[C, B]`` or ``[B]``.
        target: Targets, of the same shape.
        loss_function: ``"l1"``, ``"l2"``, ``"smooth_l1"`` or ``"pal"``.
        unit: Error at which the last two bend. A loss whose rewards are scaled gives its factor
            here, so that they bend at an error of one in units of the environment's reward; a
            bend that moves comes as a number for each transition, shape ``[B]``.
        pal_alpha: Priority exponent that PAL stands for.

    Returns:
        Loss, of the same shape.

    Raises:
        ValueError: If the name is unknown.

    Examples:
        >>> distance(torch.zeros(1), torch.full((1,), 3.0), "smooth_l1").tolist()
        [2.5]
    """
    if loss_function not in DISTANCES:
        raise ValueError(f"loss_function must be one of {DISTANCES}, got {loss_function!r}")
    if loss_function == PAL:
        return pal_distance((target - value) / unit, alpha=pal_alpha) * unit**2
    if loss_function == "smooth_l1":
        error = (target - value) / unit
        bent = torch.nn.functional.huber_loss(error, torch.zeros_like(error), reduction="none")
        return bent * unit**2
    found: Tensor = distance_loss(value, target, loss_function)
    return found


def pal_distance(error: Tensor, *, alpha: float = 0.4) -> Tensor:
    r"""Loss of which uniform sampling expects the gradient that LAP has.

    .. math::

        \frac{1}{\lambda} \begin{cases} \tfrac12 \delta^2 & |\delta| \le 1 \\
        \frac{|\delta|^{1 + \alpha}}{1 + \alpha} & \text{else} \end{cases} \qquad
        \lambda = \frac1B \sum_j \max(|\delta_j|, 1)^\alpha

    Fujimoto et al. (2020), "An equivalence between loss functions and non-uniform sampling in
    experience replay", https://arxiv.org/abs/2007.06049.

    Args:
        error: TD errors, shape ``[C, B]`` or ``[B]``; of several critics the largest one is in
            :math:`\lambda`.
        alpha: Priority exponent :math:`\alpha` of the sampling that it stands for.

    Returns:
        Loss of each transition, of the same shape.

    Examples:
        >>> pal_distance(torch.tensor([0.5, -0.5])).tolist()
        [0.125, 0.125]
    """
    size = error.abs()
    # A power with a fractional exponent has no finite slope at zero, where it is not wanted.
    far = size.clamp_min(1.0).pow(1.0 + alpha) / (1.0 + alpha)
    loss = torch.where(size <= 1.0, 0.5 * size.square(), far)
    largest = size.detach() if error.ndim == 1 else size.detach().amax(0)
    return loss / largest.clamp_min(1.0).pow(alpha).mean()


def saturation(preactivation: Tensor, *, limit: float) -> Tensor:
    r"""How deep actions lie in the flat ends of the tanh, the mean of :math:`\max(0, |u| - l)^2`.

    Args:
        preactivation: Actions before the tanh :math:`u`, shape ``[B, A]``.
        limit: The limit :math:`l`.

    Returns:
        The mean, shape ``[]``.

    Examples:
        >>> saturation(torch.tensor([[0.5, -3.5]]), limit=1.5).item()
        2.0
    """
    return (preactivation.abs() - limit).clamp_min(0).square().mean()


def action_gradient(value: Tensor, action: Tensor) -> Tensor:
    r"""Gradient of each transition's Q by its own action, :math:`\nabla_a Q(s_i, a_i)` (Eq. 14).

    The gradient of the sum has them all at once, as no transition enters another one's value;
    layers that mix a batch (batch normalization) would break that.

    Args:
        value: Q, shape ``[B]``.
        action: The actions that it was computed from, shape ``[B, A]``.

    Returns:
        The gradient, detached, shape ``[B, A]``; ``value`` can still be differentiated.

    Examples:
        >>> action = torch.tensor([[3.0], [4.0]], requires_grad=True)
        >>> action_gradient(action.square().sum(-1), action).tolist()
        [[6.0], [8.0]]
    """
    (gradient,) = torch.autograd.grad(
        value, action, grad_outputs=torch.ones_like(value), retain_graph=True
    )
    return gradient.detach()
