"""Exploration by Gaussian noise: one function for tensors and for TorchRL's collectors."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import ExplorationType
from torchrl.envs.utils import exploration_type
from torchrl.modules import AdditiveGaussianModule


class GaussianNoise(AdditiveGaussianModule):
    r"""TorchRL's Gaussian noise on actions, which is a function of tensors as well.

    For the same state of the generator :meth:`noisy` gives the numbers of
    :class:`~torchrl.modules.AdditiveGaussianModule`, without tensordict, exploration type and
    search of the spec, which cost a robot that acts alone more than its network. As the last part
    of a ``TensorDictSequential`` the module calls the same function. The standard deviation falls
    by ``step``, as TorchRL's does.

    Args:
        spec: Range of actions, such as ``env.action_spec``, in which noisy actions are held; None:
            it is set later, as TorchRL's collectors do.
        sigma_init: Standard deviation at the start.
        sigma_end: Standard deviation at the end; no larger.
        annealing_num_steps: Steps in which it falls.
        action_key: Key of the actions in a tensordict.
        device: Device on which the noise is drawn; None: PyTorch's default.

    Examples:
        >>> from torchrl_mpfa import make_actor
        >>> actor = make_actor(24, 2)
        >>> noise = GaussianNoise(Bounded(-1.0, 1.0, (2,)), 1.0, 0.2, annealing_num_steps=4)
        >>> action = noise.noisy(actor.act(torch.rand(1, 24)))
        >>> action.shape, bool((action.abs() <= 1.0).all())
        (torch.Size([1, 2]), True)
        >>> noise.step()
        >>> round(noise.sigma.item(), 2)
        0.8

        With TorchRL's collectors:

        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictSequential
        >>> policy = TensorDictSequential(actor, noise)
        >>> policy(TensorDict({"observation": torch.rand(1, 24)}, [1]))["action"].shape
        torch.Size([1, 2])
    """

    def __init__(
        self,
        spec: TensorSpec | None = None,
        sigma_init: float = 1.0,
        sigma_end: float = 0.1,
        annealing_num_steps: int = 1000,
        *,
        action_key: NestedKey = "action",
        device: torch.device | None = None,
    ) -> None:
        super().__init__(
            spec, sigma_init, sigma_end, annealing_num_steps, action_key=action_key, device=device
        )
        self._kept: tuple[Bounded, Tensor, Tensor] | None = None

    def noisy(self, action: Tensor) -> Tensor:
        """Add noise to actions, ``[..., A]``, and hold the sum in their range.

        Raises:
            ValueError: If the noise has no spec yet.
        """
        if self.spec is None:
            raise ValueError("spec must be an action spec, got None: set it, as env.action_spec")
        # Where TorchRL draws it, so that the numbers are the same.
        mean = self.mean
        noise = torch.randn(action.shape, dtype=mean.dtype, device=mean.device)
        moved = action + noise.to(action.device) * self.sigma
        spec = self.spec[self.action_key]
        if not isinstance(spec, Bounded):
            return spec.project(moved)
        return moved.clamp(*self._ends(spec, moved.device))

    def _ends(self, spec: Bounded, device: torch.device) -> tuple[Tensor, Tensor]:
        """Look up least and greatest actions, kept as a spec makes them anew for each call."""
        if self._kept is None or self._kept[0] is not spec or self._kept[1].device != device:
            self._kept = spec, spec.space.low.to(device), spec.space.high.to(device)
        return self._kept[1:]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add noise to the actions of a tensordict, unless exploration is switched off."""
        if exploration_type() in (ExplorationType.RANDOM, None):
            tensordict.set(self.action_key, self.noisy(tensordict.get(self.action_key)))
        return tensordict

    def step(self, frames: int = 1) -> None:
        """Lower the standard deviation by as many steps."""
        held, end, first = self.sigma, self.sigma_end.item(), self.sigma_init
        sigma = held.item()
        if sigma <= end:
            return
        slope = _slope(first.item(), end, self.annealing_num_steps, first.dtype)
        for _ in range(frames):
            # Rounded in each step, as TorchRL's tensors are.
            sigma = float(np.float32(max(end, sigma - slope)))
        held.fill_(sigma)


@cache
def _slope(first: float, last: float, steps: int, dtype: torch.dtype) -> float:
    """Compute the fall in a step, rounded as TorchRL's tensors are."""
    fall = torch.tensor(first, dtype=dtype) - torch.tensor(last, dtype=dtype)
    return (fall / steps).item()
