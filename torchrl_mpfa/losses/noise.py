"""A network that learns how noisy targets are, for the signal of UPER."""

from __future__ import annotations

from copy import deepcopy

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

LEAST_NOISE = 0.05
"""Standard deviation below which a target counts as certain, in units of the reward: without noise
the errors of a network would otherwise be infinitely informative."""
QUANTILES = 16
"""Quantiles of a target that the network learns."""


def last_layer(critic: TensorDictModule) -> str:
    """Name of the layer of a critic that gives Q.

    Raises:
        ValueError: If its last linear layer does not have one output.
    """
    linear = [(n, m) for n, m in critic.named_modules() if isinstance(m, nn.Linear)]
    name, layer = linear[-1] if linear else ("", None)
    if layer is None or layer.out_features != 1:
        raise ValueError(
            "signal 'information_gain' needs a critic whose last linear layer has one output, got "
            f"{'none' if layer is None else layer}"
        )
    return name


def with_quantiles(critic: TensorDictModule) -> TensorDictModule:
    """Change a copy of a critic into a network with new weights and :data:`QUANTILES` outputs."""
    name, network = last_layer(critic), deepcopy(critic)
    last = network.get_submodule(name)
    like = {"device": last.weight.device, "dtype": last.weight.dtype}
    place, _, attribute = name.rpartition(".")
    has_bias = last.bias is not None
    wider = nn.Linear(last.in_features, QUANTILES, bias=has_bias, **like)
    setattr(network.get_submodule(place), attribute, wider)
    for module in network.modules():
        if callable(reset := getattr(module, "reset_parameters", None)):
            reset()
    # All quantiles are equal at the start: a target is taken for certain until it was seen to vary.
    nn.init.zeros_(wider.weight)
    if has_bias:
        nn.init.zeros_(wider.bias)
    return network


def quantile_loss(quantiles: Tensor, target: Tensor) -> Tensor:
    r"""Loss of quantile regression, :math:`\frac1N \sum_k u_k (\tau_k - 1[u_k < 0])`.

    With :math:`u_k = y - \theta_k` and :math:`\tau_k = (k - \frac12) / N`, Dabney et al. (2018),
    https://arxiv.org/abs/1710.10044; from ``[B, N]`` and ``[B]`` to ``[B]``.
    """
    count = quantiles.shape[-1]
    middle = (torch.arange(count, device=quantiles.device) + 0.5) / count
    error = target.unsqueeze(-1) - quantiles
    return torch.maximum(middle * error, (middle - 1.0) * error).mean(-1)
