"""Mirror images of transitions: for a symmetric robot left and right are alike."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import Transform

from mpfa_envs.checks import check_share
from mpfa_envs.robots.discrete import WheelPairs, mirrored_places, read_choices
from mpfa_envs.sensing.observation import Memory, observation_slices


class Mirror(nn.Module):
    """Swaps left and right, as if the world were seen in a mirror.

    Args:
        sectors: Number of sectors of the lidar.
        memory: ``"map"`` if observations have the path on the robot's map.
        history: Number of earlier scans in an observation.
        pairs: The pairs of wheel speeds that actions choose among, one-hot, as behind
            :class:`~mpfa_envs.DiscreteWheels`; None: actions are wheel speeds.

    Raises:
        ValueError: If a pair has no mirror image among them.

    Examples:
        >>> mirror = Mirror()
        >>> mirror.action(torch.tensor([1.0, -0.5]))
        tensor([-0.5000,  1.0000])
    """

    order: Tensor
    sign: Tensor
    swapped: Tensor

    def __init__(
        self,
        *,
        sectors: int = 18,
        memory: Memory = "none",
        history: int = 0,
        pairs: WheelPairs | None = None,
    ) -> None:
        super().__init__()
        parts = observation_slices(sectors, memory=memory, history=history)
        size = max(part.stop for part in parts.values())
        order = torch.arange(size)
        order[parts["lidar"]] = order[parts["lidar"]].flip(0)
        if history:
            scans = order[parts["lidar_history"]].view(history, sectors)
            order[parts["lidar_history"]] = scans.flip(1).flatten()
        sign = torch.ones(size)
        sign[parts["goal_direction"].start + 1] = -1.0  # The sine, positive to the left.
        sign[parts["angular_speed"]] = -1.0
        if memory == "map":
            sign[parts["way_direction"].start + 1] = -1.0
        swapped = torch.tensor([1, 0]) if pairs is None else mirrored_places(pairs)
        self._choosing = pairs is not None
        self.register_buffer("swapped", swapped, persistent=False)
        self.register_buffer("order", order, persistent=False)
        self.register_buffer("sign", sign, persistent=False)

    def observation(self, observation: Tensor) -> Tensor:
        """Mirror observations, shape ``[..., O]``."""
        order, sign = self.order.to(observation.device), self.sign.to(observation.device)
        return observation.index_select(-1, order) * sign

    def action(self, action: Tensor) -> Tensor:
        """Mirror actions, ``[..., 2]``, or choices of ``K`` pairs, ``[..., K]`` or ``[..., 1]``."""
        swapped, width = self.swapped.to(action.device), len(self.swapped)
        if self._choosing and action.shape[-1] == 1:
            return swapped[read_choices(action, width)].unsqueeze(-1).to(action.dtype)
        if action.shape[-1] != width:
            raise ValueError(f"action must have the shape [..., {width}], got {[*action.shape]}")
        return action.index_select(-1, swapped)


class RandomMirror(Transform):
    """Shows a learner each sampled transition as it was, or in the mirror.

    The mirror image of a transition is as true as the transition itself, with the same reward and
    end. A signal that a loss then writes, say the TD error, is that of what it was shown. Append it
    to a replay buffer; stored transitions stay as they were. ``"behavior_mean"``, an action without
    its noise, is mirrored where a batch has it.

    Args:
        chance: Share of the transitions that are mirrored, in [0, 1].
        sectors: Number of sectors of the lidar.
        memory: As for :class:`Mirror`.
        history: As for :class:`Mirror`.
        pairs: As for :class:`Mirror`.
        generator: Source of the choices; None: PyTorch's own.

    Raises:
        ValueError: If chance is not in [0, 1], or a pair has no mirror image.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> from mpfa_envs import RandomMirror, make_navigation_env
        >>> env = make_navigation_env("A", physics="kinematic", seed=0)
        >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), batch_size=32)
        >>> buffer = buffer.append_transform(RandomMirror())
        >>> index = buffer.extend(env.rollout(10))
        >>> buffer.sample()["observation"].shape
        torch.Size([32, 24])
        >>> env.close()
    """

    def __init__(
        self,
        *,
        chance: float = 0.5,
        sectors: int = 18,
        memory: Memory = "none",
        history: int = 0,
        pairs: WheelPairs | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.chance = check_share("chance", chance)
        self.mirror = Mirror(sectors=sectors, memory=memory, history=history, pairs=pairs)
        self.generator = generator

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Mirror some transitions of a batch ``[B]`` in place."""
        number = torch.rand(tensordict.batch_size, generator=self.generator)
        chosen = (number < self.chance).unsqueeze(-1).to(tensordict.get("action").device)
        for key in ("observation", ("next", "observation")):
            seen = tensordict.get(key)
            tensordict.set(key, torch.where(chosen, self.mirror.observation(seen), seen))
        for key in ("action", "behavior_mean"):
            done = tensordict.get(key, None)
            if done is not None:
                # Numbers of choices may come without a dimension of their own.
                each = done.unsqueeze(-1) if done.ndim == tensordict.ndim else done
                mirrored = torch.where(chosen, self.mirror.action(each), each)
                tensordict.set(key, mirrored.reshape(done.shape))
        return tensordict
