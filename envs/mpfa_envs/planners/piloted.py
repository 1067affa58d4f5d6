"""A planner on a robot: a pilot with the card that an exported policy would have."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mpfa_envs.deploy.card import Card
from mpfa_envs.deploy.pilot import Pilot
from mpfa_envs.deploy.rehearsal import rehearse
from mpfa_envs.env.config import TaskConfig
from mpfa_envs.planners.map_planner import MapPlanner
from mpfa_envs.safety.filter import CLEARANCE

if TYPE_CHECKING:
    from mpfa_envs.control.predictive import PredictiveControl
    from mpfa_envs.planners.dynamic_window import DynamicWindow


def pilot_of(planner: MapPlanner | DynamicWindow | PredictiveControl, **options: Any) -> Pilot:
    """A pilot that a planner drives, with a map, and with a filter if its robot can stop."""
    card = card_of(TaskConfig(**planner.env_arguments | {"memory": "map"}))
    if card.robot.can_stop:
        options.setdefault("clearance", CLEARANCE)
    if not isinstance(planner, MapPlanner):  # That one plans in a world which is not known yet.
        rehearse(Pilot(card, planner, **options))
    return Pilot(card, planner, **options)


def card_of(task: TaskConfig) -> Card:
    """What a driver of a task senses and may do, as a card says it."""
    lidar = task.make_lidar()
    return Card(
        observation_size=max(part.stop for part in task.observation_slices.values()),
        action_size=2,
        sectors=lidar.sectors,
        field_of_view=lidar.field_of_view,
        reduction=lidar.reduction,
        max_range=lidar.max_range,
        closeness_distance=task.closeness_distance,
        memory=task.memory,
        history=task.history,
        robot=task.robot,
        period=task.action_time,
        goal_radius=task.goal_radius,
        env_arguments={"action_repeat": task.action_repeat},
        training={},
    )
