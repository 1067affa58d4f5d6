"""The parameters of the policy's node, and what it makes of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from mpfa_envs.checks import check_not_negative, check_positive
from mpfa_envs.deploy import Pilot
from mpfa_envs.deploy.card import Network, read_exported
from mpfa_envs.ros.controller import Controller
from mpfa_envs.ros.rehearsal import rehearse
from mpfa_envs.safety.filter import CLEARANCE

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from mpfa_envs.deploy.card import Card

PARAMETERS: Final[dict[str, Any]] = {
    "driver": "policy",
    "policy": "",
    "robot": "",
    "pace": 0.0,
    "mount": [0.0, 0.0, 0.0],
    "unseen": 0.0,
    "silent": "reject",
    "map_size": 40.0,
    "clearance": -1.0,
    "approach": 0.0,
    "latency": -1.0,
    "goal_radius": 0.0,
    "goal_heading": True,
    "stop_distance": 0.05,
    "scan_timeout": 0.5,
    "odometry_timeout": 0.5,
    "transform_timeout": 1.0,
    "rate": 20.0,
    "trust_stamps": True,
    "stamped": False,
    "base_frame": "",
    "scan_topic": "scan",
    "odometry_topic": "odom",
    "goal_topic": "goal_pose",
    "map_topic": "",
    "command_topic": "cmd_vel",
    "action": "navigate_to_pose",
    "autostart": True,
}
"""The parameters with their defaults; docs/robot.md explains them."""
LIVE: Final = ("clearance", "goal_radius", "scan_timeout")
"""Those that may change while the robot drives."""


def make_controller(value: Callable[[str], Any]) -> Controller:
    """Make the controller of a node's parameters; all loops are compiled then."""
    make = _maker(value)
    # Loops that the first decision compiled would hold up the checks for seconds.
    rehearse(make())
    pilot = make()
    limits = {name: value(name) for name in ("stop_distance", "scan_timeout", "odometry_timeout")}
    rate = check_positive("rate", value("rate"))
    if (topic := value("map_topic")) and pilot.card.memory != "map":
        raise ValueError(f"map_topic must be '' for a policy without a map, got {topic!r}")
    return Controller(pilot, **limits, check_period=1.0 / rate)


def _maker(value: Callable[[str], Any]) -> Callable[[], Pilot]:
    """Make what makes the pilot, by a policy or by a planner."""
    name, policy, robot = value("driver"), value("policy"), value("robot") or None
    options = dict(
        pace=value("pace") or None,
        mount=tuple(value("mount")) if any(value("mount")) else None,
        unseen=value("unseen") or None,
        silent=value("silent"),
        map_size=value("map_size"),
        approach=value("approach"),
        latency=None if value("latency") < 0.0 else value("latency"),
        goal_radius=value("goal_radius") or None,
    )
    clearance = value("clearance")
    if name == "policy":
        card, content = read_exported(policy)
        kept = _clearance(clearance, card)
        sizes = card.observation_size, card.action_size
        return lambda: Pilot(card, Network(content, *sizes), robot=robot, clearance=kept, **options)
    if policy or robot is None:
        raise ValueError(
            f"driver must be 'policy' with a policy and without a robot, got {name!r} with "
            f"policy={policy!r} and robot={robot!r}: a planner needs the robot alone"
        )
    if clearance >= 0.0:
        options["clearance"] = clearance or None
    # Planners need Numba, and so a second to import.
    from mpfa_envs.planners import make_pilot

    return lambda: make_pilot(name, robot=robot, **options)


def _clearance(clearance: float, card: Card) -> float | None:
    """What the filter keeps [m]; None: no filter. A negative number is what the policy needs."""
    if clearance < 0.0:
        return CLEARANCE if card.needs_filter else None
    return clearance or None


def check_change(changes: Mapping[str, Any], controller: Controller) -> None:
    """Reject changes of parameters that a configured node cannot take."""
    for name, value in changes.items():
        if name in PARAMETERS and name not in LIVE:
            raise ValueError(
                f"{name} cannot change while the node is configured: clean it up first, or change "
                f"one of {', '.join(LIVE)}"
            )
        if name in ("goal_radius", "scan_timeout"):
            check_positive(name, value)
        if name == "clearance":
            check_not_negative(name, value)
            if controller.pilot.has_filter and not value:
                raise ValueError(
                    "clearance must stay positive while the node is configured, as without its "
                    f"filter the robot would touch things, got {value}: clean the node up first"
                )


def change(changes: Mapping[str, Any], controller: Controller) -> None:
    """Take changes of parameters that were checked."""
    controller.pilot.adjust(
        clearance=changes.get("clearance") or None, goal_radius=changes.get("goal_radius")
    )
    controller.set_scan_timeout(changes.get("scan_timeout", controller.scan_timeout))
