"""Target networks, moved in one call."""

from __future__ import annotations

from torch.optim.swa_utils import get_ema_multi_avg_fn
from torchrl.objectives import LossModule, SoftUpdate


class MultiTensorSoftUpdate(SoftUpdate):
    r"""Target networks, :math:`\theta' \leftarrow \tau\theta + (1 - \tau)\theta'` (Eqs. 6-7).

    :class:`~torchrl.objectives.SoftUpdate` with all tensors in one call: one by one they take
    a fifth of a training step.

    Args:
        loss: A loss with target parameters; they are set to the current ones.
        tau: :math:`\tau`.

    Examples:
        >>> from torchrl_mpfa import make_actor, make_critic, make_ddpg_loss
        >>> loss = make_ddpg_loss(make_actor(24, 2), make_critic(24, 2))
        >>> MultiTensorSoftUpdate(loss, tau=0.01).step()
    """

    def __init__(self, loss: LossModule, *, tau: float) -> None:
        super().__init__(loss, tau=tau)
        params = dict(loss.named_parameters())
        buffers = {**params, **dict(loss.named_buffers())}
        pairs = [(p, buffers.get(f"target_{name}")) for name, p in params.items()]
        self._pairs = [(online, target) for online, target in pairs if target is not None]
        self.share = tau
        self._move = get_ema_multi_avg_fn(1.0 - tau)

    def step(self) -> None:
        """Move every target parameter by tau."""
        online, target = zip(*self._pairs, strict=True)
        self._move(list(target), list(online), 0)
