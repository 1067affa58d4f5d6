"""Mirror images of transitions: left and right are alike, and for some robots front and rear."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import Transform

from mpfa_envs.checks import check_share
from mpfa_envs.robots.discrete import WheelPairs, mirrored_places, read_choices
from mpfa_envs.sensing.observation import Memory, observation_slices


class Mirror(nn.Module):
    """Swaps left and right, or front and rear, as if the world were seen in a mirror.

    After both the robot has turned round: what it sees and does is that of a robot that was put
    down the other way round.

    Args:
        sectors: Number of sectors of the lidar.
        memory: ``"map"`` if observations have the path on the robot's map.
        history: Number of earlier scans in an observation.
        pairs: The pairs of wheel speeds that actions choose among, one-hot, as behind
            :class:`~mpfa_envs.DiscreteWheels`; None: actions are wheel speeds.
        front_rear: True to swap front and rear. The wheels must be as fast backwards, and the lidar
            see all around (``field_of_view=360``).
        further: Places that the values of further sensors have in the mirror.

    Raises:
        ValueError: If a pair has no mirror image among them, or front and rear are to be swapped
            with pairs, with an odd number of sectors or with further sensors.

    Examples:
        >>> mirror = Mirror()
        >>> mirror.action(torch.tensor([1.0, -0.5]))
        tensor([-0.5000,  1.0000])
        >>> Mirror(sectors=36, front_rear=True).action(torch.tensor([1.0, -0.5]))
        tensor([-1.0000,  0.5000])
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
        front_rear: bool = False,
        further: Sequence[int] = (),
    ) -> None:
        super().__init__()
        parts = observation_slices(sectors, memory=memory, history=history)
        if front_rear and pairs is not None:
            raise ValueError(f"pairs must be None with front_rear, got {pairs!r}")
        if front_rear and len(further):
            raise ValueError(f"further must be empty with front_rear, got {further!r}")
        if front_rear and sectors % 2:
            raise ValueError(f"sectors must be even with front_rear, got {sectors}")
        size = max(part.stop for part in parts.values())
        # A scan goes from the left to the right, of a whole turn from the rear to the rear.
        shift = sectors // 2 if front_rear else 0
        order = torch.arange(size)
        order[parts["lidar"]] = order[parts["lidar"]].flip(0).roll(shift)
        if history:
            scans = order[parts["lidar_history"]].view(history, sectors)
            order[parts["lidar_history"]] = scans.flip(1).roll(shift, 1).flatten()
        order = torch.cat([order, size + torch.tensor([*further], dtype=torch.long)])
        sign = torch.ones(len(order))
        # The cosine is positive ahead, the sine to the left.
        turned = 0 if front_rear else 1
        sign[parts["goal_direction"].start + turned] = -1.0
        sign[parts["angular_speed"]] = -1.0
        if memory == "map":
            sign[parts["way_direction"].start + turned] = -1.0
        if front_rear:
            sign[parts["linear_speed"]] = -1.0
        swapped = torch.tensor([1, 0]) if pairs is None else mirrored_places(pairs)
        self._choosing, self._front_rear = pairs is not None, front_rear
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
        return -action if self._front_rear else action.index_select(-1, swapped)


class RandomMirror(Transform):
    """Shows a learner each sampled transition as it was, or in the mirror.

    With ``front_rear`` there is a second mirror, so that a transition is shown as it was, in either
    mirror, or in both, which is a half turn. :meth:`mpfa_envs.TaskConfig.make_mirror` makes that of
    a task.

    The mirror image of a transition is as true as the transition itself, with the same reward and
    end. A signal that a loss then writes, say the TD error, is that of what it was shown. Append it
    to a replay buffer; stored transitions stay as they were. ``"behavior_mean"``, an action without
    its noise, is mirrored where a batch has it.

    Args:
        chance: Share of the transitions that a mirror shows, in [0, 1].
        sectors: Number of sectors of the lidar.
        memory: As for :class:`Mirror`.
        history: As for :class:`Mirror`.
        pairs: As for :class:`Mirror`.
        front_rear: True to swap front and rear, too, under the conditions of :class:`Mirror`.
        further: As for :class:`Mirror`.
        generator: Source of the choices; None: PyTorch's own.

    Raises:
        ValueError: If chance is not in [0, 1], or :class:`Mirror` raises it.

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
        front_rear: bool = False,
        further: Sequence[int] = (),
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.chance = check_share("chance", chance)
        self.mirrors = [
            Mirror(
                sectors=sectors,
                memory=memory,
                history=history,
                pairs=pairs,
                front_rear=each,
                further=further,
            )
            for each in ((False, True) if front_rear else (False,))
        ]
        self.generator = generator

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Mirror some transitions of a batch ``[B]`` in place."""
        for mirror in self.mirrors:
            number = torch.rand(tensordict.batch_size, generator=self.generator)
            chosen = (number < self.chance).unsqueeze(-1).to(tensordict.get("action").device)
            for key in ("observation", ("next", "observation")):
                seen = tensordict.get(key)
                tensordict.set(key, torch.where(chosen, mirror.observation(seen), seen))
            for key in ("action", "behavior_mean"):
                done = tensordict.get(key, None)
                if done is not None:
                    # Numbers of choices may come without a dimension of their own.
                    each = done.unsqueeze(-1) if done.ndim == tensordict.ndim else done
                    mirrored = torch.where(chosen, mirror.action(each), each)
                    tensordict.set(key, mirrored.reshape(done.shape))
        return tensordict
