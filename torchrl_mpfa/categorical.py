r"""A value as the mean of a histogram, learned by cross-entropy with a Gaussian around the target.

HL-Gauss of Farebrother et al. (2024), "Stop regressing: training value functions via classification
for scalable deep RL", https://arxiv.org/abs/2403.03950. A single outlier among the targets moves a
histogram by no more than its own share, where the squared error lets it pull with all its distance.

``K`` bins of one width lie between the two ends of a range; :math:`Q = \sum_k p_k c_k` with the
centers :math:`c_k` of the bins and the softmax :math:`p` of the critic's outputs.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

HL_GAUSS = "hl_gauss"
"""Name of the loss function."""
LOGITS = "value_logits"
"""Where a critic writes the histogram before its softmax."""
_SPREAD = 0.75
"""Standard deviation of the Gaussian in bins, as in the paper."""

Range = tuple[float, float]


def bin_edges(logits: Tensor, value_range: Range) -> Tensor:
    """Edges of the bins, shape ``[K + 1]``.

    Args:
        logits: Of any histogram, for their number, type and device, shape ``[..., K]``.
        value_range: Least and greatest value.

    Returns:
        The edges.

    Examples:
        >>> bin_edges(torch.zeros(2), (-1.0, 1.0)).tolist()
        [-1.0, 0.0, 1.0]
    """
    low, high = value_range
    count = logits.shape[-1] + 1
    return torch.linspace(low, high, count, dtype=logits.dtype, device=logits.device)


def mean_value(logits: Tensor, value_range: Range) -> Tensor:
    """Mean of a histogram, shape ``[..., K]`` to ``[...]``.

    Args:
        logits: Histogram before its softmax.
        value_range: Least and greatest value.

    Returns:
        The mean.

    Examples:
        >>> mean_value(torch.tensor([0.0, 0.0, 50.0]), (0.0, 3.0)).item()
        2.5
    """
    edges = bin_edges(logits, value_range)
    return (logits.softmax(-1) * (edges[1:] + edges[:-1]) / 2).sum(-1)


def gaussian_histogram(target: Tensor, edges: Tensor) -> Tensor:
    """Share of each bin in a Gaussian around a target, cut at the ends of the range.

    Args:
        target: Targets, shape ``[...]``; those outside the range count as its end.
        edges: Edges of the bins, shape ``[K + 1]``.

    Returns:
        Shares, shape ``[..., K]``, whose sum is one.

    Examples:
        >>> shares = gaussian_histogram(torch.tensor(1.5), torch.tensor([0.0, 1.0, 2.0, 3.0]))
        >>> [round(share, 3) for share in shares.tolist()]
        [0.241, 0.519, 0.241]
    """
    deviation = _SPREAD * (edges[1] - edges[0])
    inside = torch.minimum(torch.maximum(target, edges[0]), edges[-1])
    below = torch.erf((edges - inside.unsqueeze(-1)) / (math.sqrt(2.0) * deviation))
    return below.diff(dim=-1) / (below[..., -1:] - below[..., :1])


def hl_gauss_loss(logits: Tensor, target: Tensor, value_range: Range) -> Tensor:
    """Cross-entropy of a histogram with the Gaussian around its target, shape ``[...]``.

    Args:
        logits: Histogram before its softmax, shape ``[..., K]``.
        target: Targets, shape ``[...]``.
        value_range: Least and greatest value.

    Returns:
        Losses.

    Examples:
        >>> loss = hl_gauss_loss(torch.zeros(1, 4), torch.zeros(1), (-1.0, 1.0))
        >>> round(loss.item(), 4) == round(math.log(4), 4)
        True
    """
    shares = gaussian_histogram(target, bin_edges(logits, value_range))
    return -(shares * logits.log_softmax(-1)).sum(-1)
