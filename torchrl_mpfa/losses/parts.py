"""A loss as functions of tensors, of which a compiled update is made; nothing else needs it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from torchrl_mpfa.losses.averaging import AveragedNetwork
from torchrl_mpfa.losses.calling import Networks, bare
from torchrl_mpfa.networks import DirectModule


@dataclass(frozen=True)
class Parts:
    """Networks of a loss, their parameters, and the noise of its targets."""

    actor: DirectModule
    critic: DirectModule
    """Any of the critics, for its structure."""
    critic_parameters: dict[str, Tensor]
    """Parameters of all critics, ``[C, ...]`` where they are stacked."""
    target_actor: DirectModule
    target_critics: Sequence[Any]
    target_parameters: tuple[dict[str, Tensor], dict[str, Tensor]]
    """Parameters of target actor and target critics, by the same names; those of an actor that has
    no target of its own are the current ones."""
    stacked: bool
    """Whether parameters of critics are stacked, be it of one."""
    action_bounds: tuple[Tensor, Tensor] | None
    """Least and greatest action of a smoothed target; None: targets are not smoothed."""
    target_noise: Callable[[Tensor], Tensor] | None
    """Noise of a smoothed target, for actions of the same shape."""

    def split(self, parameters: dict[str, Tensor]) -> list[dict[str, Tensor]]:
        """Parameters of each critic."""
        if not self.stacked:
            return [parameters]
        count = len(self.target_critics)
        return [{name: value[i] for name, value in parameters.items()} for i in range(count)]

    def of_targets(self, parameters: dict[str, Tensor]) -> list[dict[str, Tensor]]:
        """Parameters of each target critic, by the names that its module has for them."""
        return [
            {f"{_prefix(critic)}{name}": value for name, value in own.items()}
            for critic, own in zip(self.target_critics, self.split(parameters), strict=True)
        ]


def _prefix(critic: DirectModule) -> str:
    return "network." if isinstance(critic.module, AveragedNetwork) else ""


def parts_of(loss: Any, networks: Networks) -> Parts:
    """The parts of a loss of DDPG or TD3."""
    params = getattr(loss, f"{loss._critic_name}_params")
    targets = getattr(loss, f"target_{loss._critic_name}_params")
    smooths = hasattr(loss, "min_action")
    return Parts(
        actor=networks.actor,
        critic=networks.frozen_critics[0],
        critic_parameters=bare(params),
        target_actor=networks.target_actor,
        target_critics=networks.target_critics,
        target_parameters=(bare(loss.target_actor_network_params), bare(targets)),
        stacked=bool(params.batch_size),
        action_bounds=(loss.min_action, loss.max_action) if smooths else None,
        target_noise=loss.target_noise if smooths else None,
    )
