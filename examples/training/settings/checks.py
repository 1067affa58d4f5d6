"""Checks of settings: parts are built, and their errors get the name of the setting.

Rules stand next to the settings; combinations that are not allowed stand here. Each
error is one sentence, raised before anything has started.
"""

from __future__ import annotations

from dataclasses import asdict, fields, is_dataclass, replace
from importlib.util import find_spec

import torch

from mpfa_envs import GoalRelabeling, RobotNoise, TaskConfig, world_tasks
from mpfa_envs.env.episodes import EpisodeSource
from torchrl_mpfa.checks import Rule, rules_of
from torchrl_mpfa.methods import METHODS, Method
from torchrl_mpfa.methods.registered import SIGNALS
from torchrl_mpfa.signals import OF_LEARNERS
from training.environments import FilteredRobots, episode_arguments, task_arguments
from training.evaluating import check_physics
from training.settings.environment import EnvironmentSettings
from training.settings.learners import is_discrete
from training.settings.rules import check_rules, named, up_to
from training.settings.train import TrainSettings
from training.worlds import is_of_a_test

A_METHOD: Rule = (lambda value: value in METHODS, "the name of a method")
OF_A_METHOD: dict[str, Rule] = {"name": A_METHOD, "capacity": up_to(10**9)}
"""Values of a method that a machine has room for; a method checks the rest itself."""


def check_settings(settings: TrainSettings) -> None:
    """Raise if a setting has a value that a rule or a part rejects, or does not fit the others."""
    if not settings.curriculum.stages:
        raise ValueError("curriculum.stages must name at least one world, got []")
    check_rules(settings, rules_of(type(settings)), "")
    check_rules(settings.method, OF_A_METHOD, "method.")
    for entry in fields(settings):
        group = getattr(settings, entry.name)
        if is_dataclass(group):
            check_rules(group, rules_of(type(group)), f"{entry.name}.")
    task = _check_environment(settings.environment, hindsight=settings.method.hindsight > 0)
    with named("environment."):
        FilteredRobots(settings)
    _check_stages(settings, task)
    _check_evaluation(settings)
    _check_method(settings.method)
    if is_discrete(settings.learner):
        _check_discrete(settings)
    _check_device(settings.device)
    check_physics(settings.environment.physics)
    if settings.tracking.tensorboard and find_spec("tensorboard") is None:
        raise ValueError(
            "tracking=tensorboard needs TensorBoard: install the extra 'tensorboard', see Install "
            "in the README"
        )


def _check_environment(environment: EnvironmentSettings, *, hindsight: bool) -> TaskConfig:
    """Build the task and its parts."""
    with named("environment.noise."):
        RobotNoise(**asdict(environment.noise))
    with named("environment."):
        cost = environment.filter_cost
        if cost is not None and not environment.filter:
            raise ValueError(f"filter_cost must be null where environment.filter is 0, got {cost}")
        task = TaskConfig(**task_arguments(environment))
        if environment.mirror:
            task.make_mirror()
        if hindsight:
            GoalRelabeling(task)
    return task


def _check_stages(settings: TrainSettings, task: TaskConfig) -> None:
    """Raise if stages count nothing or different units, or no episode begins in a world."""
    stages, environment = settings.curriculum.stages, settings.environment
    worlds = set()
    for number, stage in enumerate(stages):
        where = f"curriculum.stages[{number}]"
        if min(stage.episodes, stage.actions) != 0 or stage.length < 1:
            raise ValueError(
                f"{where} must have episodes or actions, at least 1, got episodes="
                f"{stage.episodes}, actions={stage.actions}"
            )
        if bool(stage.actions) != bool(stages[0].actions):
            raise ValueError(f"{where} must count what the others count, episodes or actions")
        if stage.world not in worlds:
            with named(f"{where}.world (environment.clearance={environment.clearance}): "):
                # It samples a task, which shows that there are some.
                EpisodeSource(stage.world, 1, task, **episode_arguments(environment))
            worlds.add(stage.world)


def _check_evaluation(settings: TrainSettings) -> None:
    """Raise if there are no tasks in the world of the evaluations, or none to choose by."""
    wanted = settings.evaluation
    with named("evaluation.world: "):
        world_tasks(wanted.world, episodes=1, robot=settings.environment.robot)
    if wanted.choose and not wanted.every:
        raise ValueError(
            "evaluation.choose needs evaluations: set evaluation.every, got 0, or "
            "evaluation.choose=false"
        )
    if wanted.choose and is_of_a_test(wanted.world):
        raise ValueError(
            f"evaluation.choose must be false with evaluation.world={wanted.world}, got True: "
            "nothing may be chosen in the worlds of a test"
        )


def _check_method(method: Method) -> None:
    """Raise if the method rejects its settings, or cannot learn with them."""
    with named("method."):
        replace(method)
    known = ["reward", *OF_LEARNERS, *SIGNALS]
    for signal in method.priority_signals():
        # What a signal is made of, by whatever name.
        entry = signal.key[-1] if isinstance(signal.key, tuple) else signal.key
        if entry not in known:
            raise ValueError(
                f"method.signals must be of {', '.join(known)}, got {signal.name!r}: a plugin can "
                "register others"
            )
    if method.capacity < method.rows:
        raise ValueError(
            f"method.capacity must hold a batch of {method.rows}, got {method.capacity}: it would "
            "never learn"
        )


def _check_discrete(settings: TrainSettings) -> None:
    """Raise if a setting needs continuous actions, or an actor in addition to the critic."""
    method, algorithm = settings.method, settings.learner.algorithm
    if settings.learner.compile is True:
        raise ValueError(f"learner.compile must be false with {algorithm}, got True")
    own = {"reward", "td_error", "action_gradient", *SIGNALS}
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


def _check_device(device: str) -> None:
    """Raise if PyTorch does not know a device, or does not find it."""
    try:
        kind = torch.device(device).type
    except RuntimeError as error:
        raise ValueError(f"device must be one that PyTorch knows, got {device!r}") from error
    if kind == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device={device}: PyTorch finds no GPU on this machine")
