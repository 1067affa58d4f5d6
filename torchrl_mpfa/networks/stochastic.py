"""A stochastic policy for SAC, whose action is the tanh of a Gaussian."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn.functional import softplus
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import ExplorationType
from torchrl.envs.utils import exploration_type
from torchrl.modules import ProbabilisticActor, TanhNormal

from torchrl_mpfa.checks import check_counts
from torchrl_mpfa.networks.bounds import ActionScale, action_scale
from torchrl_mpfa.networks.deterministic import DirectModule, Layers, Perceptron

_SCALE_BIAS = math.log(math.e - 1.0)
"""The softplus of this is one."""
_LEAST_SCALE = 1e-4


def sample_tanh_normal(
    loc: Tensor, scale: Tensor, action_scale: ActionScale | None = None
) -> tuple[Tensor, Tensor]:
    r"""Sample :math:`a = c + h \tanh(u)`, :math:`u \sim N(\mu, \sigma)`, with its log-density.

    .. math::

        \ln \pi(a) = \sum_j \ln N(u_j; \mu_j, \sigma_j) - \ln(1 - \tanh^2 u_j) - \ln h_j

    The same numbers as from :class:`~torchrl.modules.TanhNormal` in half the time: actions, shape
    ``[..., A]``, and log-densities, ``[...]``. Both can be differentiated by mean and scale.

    Examples:
        >>> action, log_density = sample_tanh_normal(torch.zeros(3, 2), torch.ones(3, 2))
        >>> action.shape, log_density.shape
        (torch.Size([3, 2]), torch.Size([3]))
    """
    before, noise = _sample_normal(loc, scale)
    of_normal = -0.5 * noise.square() - scale.log() - 0.5 * math.log(2.0 * math.pi)
    # The logarithm of 1 - tanh(u)^2, which would be that of zero for a large u.
    of_tanh = 2.0 * (math.log(2.0) - before - softplus(-2.0 * before))
    action, log_density = torch.tanh(before), (of_normal - of_tanh).sum(-1)
    if action_scale is None:
        return action, log_density
    return action_scale(action), log_density - action_scale.half_width.log().sum()


def _sample_normal(loc: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
    """Sample a Gaussian; return the noise of unit scale as well."""
    noise = torch.randn_like(loc)
    return loc + scale * noise, noise


class StochasticNetwork(Layers):
    """Mean and scale of an action before its tanh, each from a head of its own."""

    def __init__(self, observation_size: int, action_size: int, perceptron: Perceptron) -> None:
        super().__init__(observation_size, action_size, perceptron)
        self.scale_head = perceptron.last(action_size)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Map ``[..., O]`` to mean and scale, each ``[..., A]``."""
        features = self.body(observation)
        # Flat nowhere, as a clamped exponential is: a scale that got there would stay.
        scale = softplus(self.scale_head(features) + _SCALE_BIAS) + _LEAST_SCALE
        return self.head(features), scale


class StochasticActor(ProbabilisticActor):
    """A :class:`~torchrl.modules.ProbabilisticActor` that is a function of tensors as well.

    :class:`~torchrl_mpfa.ActorCritic` calls it directly; any other probabilistic actor works
    there, too, but slower.

    Args:
        network: Function from observations to mean and scale of the action before its tanh.
        action_size: ``A``.
        scale: The map to the bounds of actions; None: they are in [-1, 1].

    Examples:
        >>> policy = make_stochastic_actor(24, 2)
        >>> sorted(policy.outputs({"observation": torch.rand(5, 24)}))
        ['action', 'preactivation', 'scale']
        >>> policy.act(torch.rand(5, 24), random=True).shape
        torch.Size([5, 2])
    """

    def __init__(
        self, network: nn.Module, *, action_size: int, scale: ActionScale | None = None
    ) -> None:
        one = torch.ones(action_size)
        low, high = (-one, one) if scale is None else (scale(-one), scale(one))
        ends: dict[str, Tensor] = {}
        if scale is not None:  # Of the distribution, which are beyond the bounds if it is clipped.
            ends = {"low": scale.center - scale.half_width, "high": scale.center + scale.half_width}
        super().__init__(
            DirectModule(network, in_keys=["observation"], out_keys=["preactivation", "scale"]),
            in_keys={"loc": "preactivation", "scale": "scale"},
            spec=Bounded(low, high, (action_size,)),
            safe=scale is not None and scale.clips,
            distribution_class=TanhNormal,
            distribution_kwargs=ends,
        )
        self.action_scale = scale

    def layers(self) -> list[nn.Module]:
        """Return all layers in their order, from observation to the mean action."""
        scale = [] if self.action_scale is None else [self.action_scale]
        return [*self.module[0].module.layers(), nn.Tanh(), *scale]

    def outputs(
        self, inputs: Mapping[NestedKey, Tensor] | TensorDictBase, *, random: bool | None = None
    ) -> dict[NestedKey, Tensor]:
        """Compute the outputs by key, and leave the inputs as they are.

        Args:
            inputs: Tensors by key, in a mapping or a tensordict.
            random: True to sample the action; False for that of the mean. None: it is random under
                ``set_exploration_type(ExplorationType.RANDOM)``.

        Returns:
            Outputs by key.
        """
        outputs: dict[NestedKey, Tensor] = self.module[0].outputs(inputs)
        if random is None:
            asked = exploration_type() or self.default_interaction_type
            random = asked is ExplorationType.RANDOM
        before = outputs["preactivation"]
        if random:
            before, _ = _sample_normal(before, outputs["scale"])
        return {**outputs, "action": self.mean_action(before)}

    def act(self, observation: Tensor, *, random: bool = False) -> Tensor:
        """Choose actions, ``[..., A]``, without gradients, whatever the exploration type is.

        Args:
            observation: Observations, ``[..., O]``.
            random: True to sample the actions; False for those of the means.

        Returns:
            Actions.
        """
        with torch.no_grad():
            return self.outputs({"observation": observation}, random=random)["action"]

    def mean_action(self, preactivation: Tensor) -> Tensor:
        """Squash means or samples before the tanh, ``[..., A]``, to actions."""
        action = torch.tanh(preactivation)
        return action if self.action_scale is None else self.action_scale(action)

    def sample(
        self, inputs: Mapping[NestedKey, Tensor] | TensorDictBase
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Sample actions, ``[..., A]``, log-densities, ``[...]``, and the means before the tanh."""
        outputs = self.module[0].outputs(inputs)
        loc: Tensor = outputs["preactivation"]
        return *sample_tanh_normal(loc, outputs["scale"], self.action_scale), loc


def make_stochastic_actor(
    observation_size: int,
    action_size: int,
    *,
    action_spec: TensorSpec | None = None,
    saturation_limit: float | None = None,
    width: int = 256,
    layers: int = 2,
    layer_norm: bool = True,
    final_init: float | None = 3e-3,
) -> StochasticActor:
    """Make a policy from ``"observation"`` to ``"preactivation"``, ``"scale"`` and ``"action"``.

    The action is the tanh of a Gaussian with this mean (the preactivation) and scale. It is random
    under ``set_exploration_type(ExplorationType.RANDOM)``, as in TorchRL's collectors; otherwise it
    is the tanh of the mean.

    Args:
        observation_size: ``O``.
        action_size: ``A``.
        action_spec: As in :func:`~torchrl_mpfa.make_actor`.
        saturation_limit: As in :func:`~torchrl_mpfa.make_actor`. Densities are those of actions
            before the clipping.
        width: Units of each hidden layer.
        layers: Number of hidden layers.
        layer_norm: As in :func:`~torchrl_mpfa.make_actor`.
        final_init: Bound of the last layers' uniform start, hence means near zero and scales near
            one; None keeps PyTorch's start.

    Returns:
        A module for :class:`~torchrl_mpfa.ActorCritic` and TorchRL's collectors.

    Raises:
        ValueError: If a size is not a positive integer, the spec has other actions, or the limit is
            not positive.

    Examples:
        >>> policy = make_stochastic_actor(24, 2)
        >>> from tensordict import TensorDict
        >>> outputs = policy(TensorDict({"observation": torch.rand(5, 24)}, [5]))
        >>> torch.allclose(outputs["action"], outputs["preactivation"].tanh())
        True
    """
    check_counts(observation_size=observation_size, action_size=action_size)
    perceptron = Perceptron(width, layers, layer_norm, final_init)
    network = StochasticNetwork(observation_size, action_size, perceptron)
    scale = action_scale(action_spec, action_size, saturation_limit=saturation_limit)
    return StochasticActor(network, action_size=action_size, scale=scale)
