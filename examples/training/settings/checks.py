"""What values settings may have; each mistake is one sentence, before anything has started."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, fields, is_dataclass, replace
from importlib.util import find_spec
from typing import Any

import torch

from mpfa_envs import GoalRelabeling, RobotNoise, TaskConfig, world_tasks
from mpfa_envs.robots.model import resolve_robot
from torchrl_mpfa.checks import Rule, rules_of
from torchrl_mpfa.methods import METHODS, Method
from training.environments import check_physics, make_training_env, task_arguments
from training.settings.environment import EnvironmentSettings
from training.settings.learners import is_discrete
from training.settings.rules import check_rules, choice, up_to
from training.settings.train import TrainSettings
from training.worlds import is_of_a_test

OF_A_METHOD: dict[str, Rule] = {"name": choice(*METHODS), "capacity": up_to(10**9)}
"""What this machine has room for; a method checks the rest itself."""
SIGNALS = (
    *("reward", "td_error", "action_gradient", "value"),
    *("relative_value", "relative_td_error", "information_gain"),
)
"""What the losses of ``train.py`` write; a script of your own may have others."""


def check_settings(settings: TrainSettings) -> None:
    """Refuse a value that cannot be."""
    if not settings.curriculum.stages:
        raise ValueError("curriculum.stages must name at least one world, got []")
    check_rules(settings, rules_of(type(settings)), "")
    check_rules(settings.method, OF_A_METHOD, "method.")
    for entry in fields(settings):
        group = getattr(settings, entry.name)
        if is_dataclass(group):
            check_rules(group, rules_of(type(group)), f"{entry.name}.")
    _resolve("environment.robot", resolve_robot, settings.environment.robot)
    _check_environment(settings.environment, hindsight=settings.method.hindsight > 0)
    _check_stages(settings)
    _resolve(
        "evaluation.world",
        lambda word: world_tasks(word, episodes=1, robot=settings.environment.robot),
        settings.evaluation.world,
    )
    _check_method(settings.method)
    if settings.evaluation.choose and not settings.evaluation.every:
        raise ValueError(
            "evaluation.choose needs evaluations: set evaluation.every, got 0, or "
            "evaluation.choose=false"
        )
    if settings.evaluation.choose and is_of_a_test(settings.evaluation.world):
        raise ValueError(
            f"evaluation.choose must be false with evaluation.world={settings.evaluation.world}, "
            "got True: nothing may be chosen in the worlds of a test"
        )
    _check_ray(settings)
    if is_discrete(settings.learner):
        if settings.learner.compile is True:
            name = settings.learner.algorithm
            raise ValueError(f"learner.compile must be false with {name}, got True")
        _check_values_alone(settings)
    _check_device(settings.device)
    check_physics(settings.environment.physics)
    if settings.tracking.tensorboard and find_spec("tensorboard") is None:
        raise ValueError(
            "tracking=tensorboard needs TensorBoard: pip install 'torchrl-mpfa[tensorboard]'"
        )


def _check_environment(environment: EnvironmentSettings, *, hindsight: bool) -> None:
    """Have the parts of the task reject what they cannot be."""
    for prefix, make in (
        ("environment.noise.", lambda: RobotNoise(**asdict(environment.noise))),
        ("environment.", lambda: TaskConfig(**task_arguments(environment))),
        *((("environment.", lambda: _relabeling(environment)),) if hindsight else ()),
    ):
        try:
            make()
        except ValueError as error:
            raise ValueError(f"{prefix}{error}") from error


def _relabeling(environment: EnvironmentSettings) -> GoalRelabeling:
    """What a method with goals in hindsight relabels episodes with."""
    return GoalRelabeling(TaskConfig(**task_arguments(environment)))


def _check_method(method: Method) -> None:
    """Refuse what does not go together, or has no effect."""
    try:
        replace(method)
    except (TypeError, ValueError) as error:
        raise ValueError(f"method.{error}") from error
    for signal in method.priority_signals():
        if signal.name not in SIGNALS:
            raise ValueError(f"method.signals must be of {', '.join(SIGNALS)}, got {signal.name!r}")
    if method.capacity < method.rows:
        raise ValueError(
            f"method.capacity must hold a batch of {method.rows}, got {method.capacity}: it would "
            "never learn"
        )


def _check_ray(settings: TrainSettings) -> None:
    """Refuse what needs the robots, or the buffer, in the process that learns."""
    workers = settings.ray.workers
    if not workers:
        return
    if find_spec("ray") is None:
        raise ValueError(f"ray.workers={workers} needs Ray: pip install 'torchrl-mpfa[ray]'")
    if settings.robots % workers:
        raise ValueError(
            f"robots must be a multiple of ray.workers={workers}, got {settings.robots}"
        )
    if not settings.method.remote:
        raise ValueError(
            f"ray.workers must be 0 with method={settings.method.name}, got {workers}: it needs "
            "its buffer in the process that learns"
        )
    if settings.method.update_block != 1:
        raise ValueError(
            f"method.update_block must be 1 with ray.workers={workers}, got "
            f"{settings.method.update_block}"
        )


def _check_values_alone(settings: TrainSettings) -> None:
    """Refuse what a method has only where actions are numbers, or actor and critic two."""
    method, algorithm = settings.method, settings.learner.algorithm
    own = {"reward", "td_error", "action_gradient"}
    signals = [signal.name for signal in method.priority_signals()]
    # A table has no loss that could bend.
    distances = ("l2", "smooth_l1") if algorithm == "dqn" else ("l2",)
    if method.needs_actor or not own.issuperset(signals):
        raise ValueError(
            f"method={method.name} is not for learner={algorithm}, which has neither an actor nor "
            "continuous actions"
        )
    if method.loss_function not in distances:
        raise ValueError(
            f"method.loss_function must be {' or '.join(distances)} with learner={algorithm}, got "
            f"{method.loss_function}"
        )
    if algorithm == "q_learning" and settings.learner.reward_scale != 1:
        raise ValueError(
            "learner.reward_scale must be 1 with q_learning, whose table is in units of the "
            f"reward, got {settings.learner.reward_scale}"
        )
    if signals == ["action_gradient"]:
        raise ValueError(
            f"method.signals must hold reward or td_error with learner={algorithm}, which has no "
            "action gradient"
        )


def _check_stages(settings: TrainSettings) -> None:
    """Refuse stages that count nothing or different things, and worlds without a task."""
    stages = settings.curriculum.stages
    for number, stage in enumerate(stages):
        where = f"curriculum.stages[{number}]"
        if min(stage.episodes, stage.actions) != 0 or stage.length < 1:
            raise ValueError(
                f"{where} must have episodes or actions, at least 1, got episodes="
                f"{stage.episodes}, actions={stage.actions}"
            )
        if bool(stage.actions) != bool(stages[0].actions):
            raise ValueError(f"{where} must count what the others count, episodes or actions")
        _check_world(f"{where}.world", stage.world, settings)


def _resolve(name: str, resolve: Callable[[str], Any], value: str) -> None:
    """Have the error of something that is looked up name the setting."""
    try:
        resolve(value)
    except (ValueError, OSError) as error:
        raise ValueError(f"{name}: {' '.join(str(error).split())}") from error


def _check_world(name: str, world: str, settings: TrainSettings) -> None:
    """Refuse a world that there is not, or in which no episode can begin."""
    environment = replace(settings.environment, physics="kinematic")
    error = _refusal(world, environment)
    if error is None:
        return
    for setting, without in (
        ("max_goal_distance", replace(environment, max_goal_distance=None)),
        ("clearance", replace(environment, clearance=0.0)),
    ):
        if _refusal(world, without) is None:
            name += f", environment.{setting}={getattr(environment, setting)}"
    raise ValueError(f"{name}: {' '.join(str(error).split())}") from error


def _refusal(world: str, environment: EnvironmentSettings) -> Exception | None:
    """Why no episode begins in a world, if none does."""
    try:
        env = make_training_env(world, environment)
        env.set_seed(0)
        env.reset()
    except (ValueError, OSError) as error:
        return error
    env.close()
    return None


def _check_device(device: str) -> None:
    try:
        kind = torch.device(device).type
    except RuntimeError as error:
        raise ValueError(f"device must be one that PyTorch knows, got {device!r}") from error
    if kind == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device={device}: PyTorch finds no GPU on this machine")
