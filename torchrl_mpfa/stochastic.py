"""A stochastic policy for SAC, whose action is the tanh of a Gaussian."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import chain, pairwise

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn.functional import softplus
from torchrl.data import Bounded
from torchrl.envs import ExplorationType
from torchrl.envs.utils import exploration_type
from torchrl.modules import ProbabilisticActor, TanhNormal

from torchrl_mpfa.networks import DirectModule, _check_sizes, _last, _layer

_SCALE_BIAS = math.log(math.e - 1.0)
"""The softplus of this is one."""
_LEAST_SCALE = 1e-4


def draw_tanh_normal(loc: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
    r"""Draw actions :math:`a = \tanh(u)`, :math:`u \sim N(\mu, \sigma)`, with their log-density.

    .. math::

        \ln \pi(a) = \sum_j \ln N(u_j; \mu_j, \sigma_j) - \ln(1 - \tanh^2 u_j)

    The same numbers as from :class:`~torchrl.modules.TanhNormal` in half the time. Both results
    can be differentiated by mean and scale.

    Args:
        loc: Means :math:`\mu`, shape ``[..., A]``.
        scale: Standard deviations :math:`\sigma`, shape ``[..., A]``.

    Returns:
        Actions, shape ``[..., A]``, and their log-densities, shape ``[...]``.

    Examples:
        >>> action, log_density = draw_tanh_normal(torch.zeros(3, 2), torch.ones(3, 2))
        >>> action.shape, log_density.shape
        (torch.Size([3, 2]), torch.Size([3]))
    """
    noise = torch.randn_like(loc)
    before = loc + scale * noise
    of_normal = -0.5 * noise.square() - scale.log() - 0.5 * math.log(2.0 * math.pi)
    # The logarithm of 1 - tanh(u)^2, which would be that of zero for a large u.
    of_tanh = 2.0 * (math.log(2.0) - before - softplus(-2.0 * before))
    return torch.tanh(before), (of_normal - of_tanh).sum(-1)


class StochasticNetwork(nn.Module):
    """Mean and scale of an action before its tanh, each from a head of its own."""

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        *,
        width: int,
        layers: int,
        layer_norm: bool,
        final_init: float | None,
    ) -> None:
        super().__init__()
        sizes = [observation_size, *[width] * layers]
        hidden = [_layer(a, b, layer_norm) for a, b in pairwise(sizes)]
        self.body = nn.Sequential(*chain(*hidden))
        self.head = _last(width, action_size, final_init)
        self.scale_head = _last(width, action_size, final_init)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """From ``[..., O]`` to mean and scale, each ``[..., A]``."""
        features = self.body(observation)
        # Flat nowhere, as a clamped exponential is: a scale that got there would stay.
        scale = softplus(self.scale_head(features) + _SCALE_BIAS) + _LEAST_SCALE
        return self.head(features), scale


class StochasticActor(ProbabilisticActor):
    """A :class:`~torchrl.modules.ProbabilisticActor` that is a function of tensors as well.

    :class:`~torchrl_mpfa.SignalSACLoss` calls it directly; any other probabilistic actor works
    there, too, but slower.

    Args:
        network: Function from observations to mean and scale of the action before its tanh.
        action_size: ``A``.

    Examples:
        >>> policy = make_stochastic_actor(24, 2)
        >>> sorted(policy.outputs({"observation": torch.rand(5, 24)}))
        ['action', 'preactivation', 'scale']
    """

    def __init__(self, network: nn.Module, *, action_size: int) -> None:
        super().__init__(
            DirectModule(network, in_keys=["observation"], out_keys=["preactivation", "scale"]),
            in_keys={"loc": "preactivation", "scale": "scale"},
            spec=Bounded(-1.0, 1.0, (action_size,)),
            distribution_class=TanhNormal,
        )

    def outputs(
        self, inputs: Mapping[NestedKey, Tensor] | TensorDictBase
    ) -> dict[NestedKey, Tensor]:
        """Compute the outputs and leave the inputs as they are.

        The action is drawn under ``set_exploration_type(ExplorationType.RANDOM)``; otherwise it is
        the tanh of the mean.

        Args:
            inputs: Tensors by key, in a mapping or a tensordict.

        Returns:
            Outputs by key.
        """
        found: dict[NestedKey, Tensor] = self.module[0].outputs(inputs)
        if (exploration_type() or self.default_interaction_type) is ExplorationType.RANDOM:
            action, _ = draw_tanh_normal(found["preactivation"], found["scale"])
        else:
            action = torch.tanh(found["preactivation"])
        return {**found, "action": action}

    def draw(
        self, inputs: Mapping[NestedKey, Tensor] | TensorDictBase
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Draw actions, whatever the exploration type is.

        Args:
            inputs: Tensors by key, in a mapping or a tensordict.

        Returns:
            Actions, shape ``[..., A]``, their log-densities, ``[...]``, and the means before the
            tanh, ``[..., A]``.
        """
        found = self.module[0].outputs(inputs)
        loc: Tensor = found["preactivation"]
        return *draw_tanh_normal(loc, found["scale"]), loc


def make_stochastic_actor(
    observation_size: int,
    action_size: int,
    *,
    width: int = 256,
    layers: int = 2,
    layer_norm: bool = True,
    final_init: float | None = 3e-3,
) -> StochasticActor:
    """Policy from ``"observation"`` to ``"preactivation"``, ``"scale"`` and ``"action"``.

    The action is the tanh of a Gaussian with this mean (the preactivation) and scale. It is drawn
    under ``set_exploration_type(ExplorationType.RANDOM)``, as in TorchRL's collectors; otherwise it
    is the tanh of the mean.

    Args:
        observation_size: ``O``.
        action_size: ``A``.
        width: Units of each hidden layer.
        layers: Number of hidden layers.
        layer_norm: As in :func:`~torchrl_mpfa.make_actor`.
        final_init: The last layers start uniformly within this, hence means near zero and scales
            near one; None leaves PyTorch's start.

    Returns:
        A module for :class:`~torchrl_mpfa.SignalSACLoss` and TorchRL's collectors.

    Raises:
        ValueError: If a size is below one.

    Examples:
        >>> policy = make_stochastic_actor(24, 2)
        >>> from tensordict import TensorDict
        >>> found = policy(TensorDict({"observation": torch.rand(5, 24)}, [5]))
        >>> torch.allclose(found["action"], found["preactivation"].tanh())
        True
    """
    _check_sizes(
        observation_size=observation_size, action_size=action_size, width=width, layers=layers
    )
    network = StochasticNetwork(
        observation_size,
        action_size,
        width=width,
        layers=layers,
        layer_norm=layer_norm,
        final_init=final_init,
    )
    return StochasticActor(network, action_size=action_size)
