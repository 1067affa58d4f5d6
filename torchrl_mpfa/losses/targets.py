"""Targets of the critics, by the value estimator of a loss."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives.value import TD0Estimator, TD1Estimator, TDLambdaEstimator

from torchrl_mpfa.losses.functional import bootstrap_target

_ESTIMATORS = (TD0Estimator, TD1Estimator, TDLambdaEstimator)


def as_torchrl_needs(batch: TensorDictBase, keys: Any, *, reward_scale: float) -> TensorDictBase:
    """A shallow copy of a batch with scaled rewards, and ends as booleans whatever they were.

    Args:
        batch: Transitions.
        keys: Names of ``reward``, ``done`` and ``terminated`` within ``"next"``.
        reward_scale: Factor of the rewards.

    Returns:
        The copy.
    """
    found = batch.copy()
    after = found["next"]
    after.set(keys.reward, after[keys.reward] * reward_scale)
    for key in (keys.done, keys.terminated):
        if (end := after.get(key, None)) is not None:
            after.set(key, end.bool())
    return found


class EstimatedTargets:
    """How a loss makes targets of the values of the next states."""

    tensor_keys: Any
    reward_scale: float
    value_estimator: Any
    value_type: Any
    _value_estimator: Any

    def _target(self, tensordict: TensorDictBase, next_value: Tensor) -> Tensor:
        """Targets by the loss's value estimator, shape ``[B]``."""
        after, keys, estimator = tensordict["next"], self.tensor_keys, self.value_estimator
        if not self.bootstraps_once:
            scaled = as_torchrl_needs(tensordict, keys, reward_scale=self.reward_scale)
            longer: Tensor = estimator.value_estimate(scaled, next_value=next_value.unsqueeze(-1))
            return longer.squeeze(-1)
        steps = tensordict.get(estimator.tensor_keys.steps_to_next_obs, None)
        reward = after[keys.reward] * self.reward_scale
        return bootstrap_target(
            reward.reshape(next_value.shape),
            next_value,
            after[keys.terminated].reshape(next_value.shape),
            gamma=estimator.gamma,
            steps=None if steps is None else steps.reshape(next_value.shape),
        )

    @property
    def bootstraps_once(self) -> bool:
        """Whether a target needs its own transition alone, as in Eq. (5)."""
        estimator = self.value_estimator
        return type(estimator) is TD0Estimator and not estimator.average_rewards

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> Any:
        """As in TorchRL: set how targets are made, by TD(0), TD(1) or TD(lambda).

        Args:
            value_type: A member of :class:`~torchrl.objectives.ValueEstimators`, or an estimator.
            **hyperparams: Of the estimator; ``gamma`` among them.

        Returns:
            What TorchRL's method gives.

        Raises:
            ValueError: If it is another estimator.
        """
        kept = self._value_estimator, self.value_type
        try:
            found = super().make_value_estimator(value_type, **hyperparams)  # type: ignore[misc]
        except NotImplementedError as error:
            self._value_estimator, self.value_type = kept
            raise ValueError(f"value_type is not supported: {error}") from error
        if not isinstance(self._value_estimator, _ESTIMATORS):
            made = type(self._value_estimator).__name__
            self._value_estimator, self.value_type = kept
            names = ", ".join(each.__name__ for each in _ESTIMATORS)
            raise ValueError(f"value_type must make one of {names}, got {made}")
        self._forward_value_estimator_keys()  # type: ignore[attr-defined]
        return found
