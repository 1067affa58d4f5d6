"""What the losses of this package share: their options, and how they use signals and weights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_mpfa.losses.averaging import AveragedNetwork, PastCritics
from torchrl_mpfa.losses.calling import Tensors, call, read_inputs
from torchrl_mpfa.networks import DirectModule
from torchrl_mpfa.priorities import action_gradient_priority, td_error_priority
from torchrl_mpfa.signals import ACTION_GRADIENT, TD_ERROR

Importance = Literal["critic", "torchrl", "none"]
GradientAt = Literal["stored", "policy"]
VALUE = "value"
"""Name of the signal that is Q itself, which may be negative."""
DEFAULT_SIGNALS = (TD_ERROR.name, ACTION_GRADIENT.name)
WRITTEN = (*DEFAULT_SIGNALS, VALUE)


class SignalLossMixin:
    """Options of a loss that writes signals, checked before TorchRL's constructor changes anything.

    Mixed into a :class:`~torchrl.objectives.LossModule`; the options are documented at
    :class:`~torchrl_mpfa.SignalDDPGLoss`.
    """

    tensor_keys: Any

    @staticmethod
    def _check_options(
        *,
        signals: Sequence[str],
        gradient_order: float,
        gradient_at: str,
        importance: str,
        reward_scale: float,
        saturation_penalty: float,
        saturation_limit: float,
        target_average: int,
    ) -> None:
        unknown = [name for name in signals if name not in WRITTEN]
        if unknown:
            raise ValueError(f"signals must be among {WRITTEN}, got {unknown}")
        for name, value, allowed in (
            ("gradient_at", gradient_at, ("stored", "policy")),
            ("importance", importance, ("critic", "torchrl", "none")),
        ):
            if value not in allowed:
                raise ValueError(f"{name} must be one of {allowed}, got {value!r}")
        if not (gradient_order > 0 and reward_scale > 0):
            raise ValueError(
                "gradient_order and reward_scale must be positive, got "
                f"{gradient_order} and {reward_scale}"
            )
        if saturation_penalty < 0 or saturation_limit < 0:
            raise ValueError(
                "saturation_penalty and saturation_limit must not be negative, got "
                f"{saturation_penalty} and {saturation_limit}"
            )
        if isinstance(target_average, bool) or target_average < 1:
            raise ValueError(f"target_average must be at least 1, got {target_average}")

    def _set_options(self, **options: Any) -> None:
        self._bound: Any = None
        self._deferred: tuple[Tensor, Tensor] | None = None
        self.signals = tuple(options["signals"])
        self.gradient_order: float = options["gradient_order"]
        self.gradient_at: GradientAt = options["gradient_at"]
        self.importance: Importance = options["importance"]
        self.reward_scale: float = options["reward_scale"]
        self.saturation_penalty: float = options["saturation_penalty"]
        self.saturation_limit: float = options["saturation_limit"]
        self.target_average: int = options["target_average"]
        # A list of modules, so that the past is saved, loaded and moved with the loss.
        self.past_critics = nn.ModuleList()
        if self.target_average > 1:
            # Of the current critics, which the target critics equal at the start.
            for network in self._held_critics(""):
                if not isinstance(network, DirectModule):
                    raise ValueError(
                        f"target_average = {self.target_average} needs a DirectModule as critic, "
                        f"got {type(network).__name__}"
                    )
                past = PastCritics(network.module, self.target_average - 1)
                self.past_critics.append(past)

    def _past(self) -> list[PastCritics]:
        return [past for past in self.past_critics if isinstance(past, PastCritics)]

    def _held_critics(self, prefix: str) -> list[TensorDictModule]:
        """Critics that hold the parameters whose name has this prefix, and get no gradient."""
        raise NotImplementedError

    def _averaged_critics(self) -> list[TensorDictModule]:
        """Target critics, each of them with its past ones if ``target_average`` is above one."""
        critics = self._held_critics("target_")
        if not self.past_critics:
            return critics
        return [
            DirectModule(
                AveragedNetwork(critic.module, past),
                in_keys=critic.in_keys,
                out_keys=critic.out_keys,
            )
            for critic, past in zip(critics, self._past(), strict=True)
        ]

    def keep_target_critics(self) -> None:
        """Keep the target critics as they are now for the average that later targets have."""
        if self.past_critics:
            for critic, past in zip(self._held_critics("target_"), self._past(), strict=True):
                past.push(critic.module)

    @property
    def _gradient_at_stored(self) -> bool:
        return ACTION_GRADIENT.name in self.signals and self.gradient_at == "stored"

    @property
    def _gradient_at_policy(self) -> bool:
        return ACTION_GRADIENT.name in self.signals and self.gradient_at == "policy"

    def _write_signals(
        self, tensordict: TensorDictBase, td_error: Tensor, value: Tensor, gradient: Tensor | None
    ) -> None:
        """Write ``|TD error|`` (Eq. 13), Q and the norm of the gradient (Eq. 14), each ``[B]``."""
        if gradient is not None:
            self._write_gradient(tensordict, gradient)
        if TD_ERROR.name in self.signals:
            size = td_error_priority(td_error)
            tensordict.set(self.tensor_keys.td_error_signal, size / self.reward_scale)
        if VALUE in self.signals:
            tensordict.set(self.tensor_keys.value_signal, value.detach() / self.reward_scale)

    def _write_gradient(self, tensordict: TensorDictBase, gradient: Tensor) -> None:
        size = action_gradient_priority(gradient, order=self.gradient_order)
        tensordict.set(self.tensor_keys.action_gradient_signal, size / self.reward_scale)

    def _stored_gradient(
        self, tensordict: TensorDictBase, action: Tensor, value: Tensor, *, defer: bool
    ) -> Tensor | None:
        """Gradient of Q at the stored action, ``[B, A]``; None if it is not wanted, or not yet."""
        self._deferred = None
        if self._gradient_at_policy:
            return self._policy_gradient(tensordict)
        if not self._gradient_at_stored:
            return None
        if defer and torch.is_grad_enabled():
            value.retain_grad()
            self._deferred = action, value
            return None
        return action_gradient(value, action)

    def write_action_gradient(self, tensordict: TensorDictBase) -> None:
        r"""Write the signal of Eq. (14) that the critic's loss was asked to defer.

        A transition's action enters the loss through its own Q alone, so
        :math:`\nabla_a Q = \nabla_a L / (\partial L / \partial Q)`: the backward pass of the loss
        has found it on its way, and needs no other one before it.

        Args:
            tensordict: The batch that the loss was computed of; nothing happens if it deferred
                nothing.

        Raises:
            RuntimeError: If the loss was not differentiated.
        """
        if self._deferred is None:
            return
        (action, value), self._deferred = self._deferred, None
        if action.grad is None or value.grad is None:
            raise RuntimeError(
                "the action gradient was deferred: call backward() on the loss first"
            )
        slope = value.grad.unsqueeze(-1)
        gradient = action.grad / slope
        flat = slope == 0
        if bool(flat.any()):  # Where there is no error there is nothing to divide.
            gradient = torch.where(flat, self._gradient(tensordict, action), gradient)
        self._write_gradient(tensordict, gradient)

    def _value(self, critic: TensorDictModule, source: TensorDictBase, chosen: Tensors) -> Tensor:
        """Q of a critic, shape ``[B]``, at the observations of one and the actions of the other."""
        found = call(critic, read_inputs(critic, source, chosen))
        return found[self.tensor_keys.state_action_value].squeeze(-1)

    def _policy_gradient(self, tensordict: TensorDictBase) -> Tensor:
        """Gradient of Q at the action of the current policy, shape ``[B, A]``."""
        actor = self._networks().actor  # type: ignore[attr-defined]
        with torch.no_grad():
            chosen = call(actor, read_inputs(actor, tensordict))
        return self._gradient(tensordict, chosen[self.tensor_keys.action])

    def _gradient(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        """Gradient of Q at these actions, shape ``[B, A]``."""
        critic = self._networks().frozen_critic  # type: ignore[attr-defined]
        action = action.detach().requires_grad_(True)
        with torch.enable_grad():
            value = self._value(critic, tensordict, {self.tensor_keys.action: action})
            return action_gradient(value, action)

    def _reduce(self, loss: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Mean over the batch, with the importance weights of Eq. (11), or TorchRL's way."""
        weights = self._maybe_get_priority_weight(tensordict)  # type: ignore[attr-defined]
        if self.importance == "critic":
            importance = tensordict.get(self.tensor_keys.priority_weight, None)
            if importance is not None:
                loss = loss * importance.reshape(loss.shape).to(loss.device)
        reduced: Tensor = self._reduce_loss(loss, tensordict=tensordict, weights=weights)  # type: ignore[attr-defined]
        return reduced

    def _penalize_saturation(
        self, loss: Tensor, preactivation: Tensor | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Add the penalty on actions before their tanh, ``[B, A]``; give their size for the log."""
        if preactivation is None:
            if self.saturation_penalty > 0:
                raise KeyError(
                    f"saturation_penalty is {self.saturation_penalty}, but the actor writes no "
                    f"{self.tensor_keys.preactivation!r}"
                )
            return loss, {}
        if self.saturation_penalty > 0:
            loss = loss + self.saturation_penalty * saturation(
                preactivation, limit=self.saturation_limit
            )
        return loss, {"preactivation": preactivation.detach().abs()}

    # The networks hold the parameters of the loss; these may put others in their place.

    def _apply(self, *args: Any, **kwargs: Any) -> Any:
        self._bound = None
        return super()._apply(*args, **kwargs)  # type: ignore[misc]

    def train(self, mode: bool = True) -> Any:
        """Set training mode, of the networks that the loss holds too."""
        self._bound = None
        return super().train(mode)  # type: ignore[misc]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_bound": None, "_deferred": None}


def saturation(preactivation: Tensor, *, limit: float) -> Tensor:
    r"""How deep actions lie in the flat ends of the tanh, the mean of :math:`\max(0, |u| - l)^2`.

    Args:
        preactivation: Actions before the tanh :math:`u`, shape ``[B, A]``.
        limit: The limit :math:`l`.

    Returns:
        The mean, shape ``[]``.
    """
    return (preactivation.abs() - limit).clamp_min(0).square().mean()


def action_gradient(value: Tensor, action: Tensor) -> Tensor:
    """Gradient of each transition's Q by its own action, shape ``[B, A]``.

    The gradient of the sum has them all at once, as no transition enters another one's value;
    layers that mix a batch (batch normalization) would break that.

    Args:
        value: Q, shape ``[B]``.
        action: The actions that it was computed from, shape ``[B, A]``.

    Returns:
        The gradient, detached; ``value`` can still be differentiated.
    """
    (gradient,) = torch.autograd.grad(
        value, action, grad_outputs=torch.ones_like(value), retain_graph=True
    )
    return gradient.detach()
