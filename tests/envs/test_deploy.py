"""The runtime of exported policies: it senses what the environment senses, alone and in time."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("onnx", reason="exported policies are of the extra onnx")

import mpfa_envs
from mpfa_envs import ROBOTS, NavigationEnv, RobotModel, TaskConfig
from mpfa_envs.deploy import Card, CardError, Pilot, Scan, ScanError, read_exported
from mpfa_envs.sensing.observation import observation_slices
from tests.envs.exported import card, exported
from tests.envs.process import run

KOBUKI = ROBOTS["kobuki"]
Recorded = tuple[Scan, tuple[float, float, float], tuple[float, float]]


def sense(env: NavigationEnv) -> Recorded:
    """What a robot in the place of the environment's would measure, right to left."""
    motion, angles = env.motion, env.lidar.angles
    ranges = env.lidar.cast(*motion[:3])
    scan = Scan(angles[-1], angles[0] - angles[1], ranges[::-1].copy())
    return scan, motion[:3], motion[3:]


def size_of(arguments: dict[str, Any]) -> int:
    sectors = TaskConfig(**arguments).make_lidar().sectors
    remembered = {name: arguments[name] for name in ("memory", "history") if name in arguments}
    return max(part.stop for part in observation_slices(sectors, **remembered).values())


@pytest.mark.parametrize("wrong", [{"observation_size": 25}, {"history": 2}, {"action_size": 3}])
def test_a_card_of_other_sizes_than_it_senses_is_rejected_however_it_is_made(wrong):
    with pytest.raises(ValueError, match=r"(observation|action)\.size must be"):
        replace(card(), **wrong)


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"history": 3, "robot": "burger"},
        {"lidar": {"field_of_view": 360.0, "sectors": 36}, "memory": "map"},
        {"lidar": {"reduction": "median", "rays_per_sector": 4, "sectors": 9}},
        {"lidar": {"reduction": "single", "max_range": 3.0}, "memory": "map", "history": 1},
    ],
)
def test_it_senses_what_the_environment_senses(tmp_path: Path, arguments: dict[str, Any]) -> None:
    file = exported(tmp_path, size_of(arguments), **arguments)
    options = {"closeness_distance": 0.23, "physics": "kinematic", **arguments}
    env = NavigationEnv(world="C", **options)
    pilot = Pilot.load(file, map_size=10.0)
    rng = np.random.default_rng(0)
    for episode in range(3):
        seen, _ = env.reset(seed=episode)
        assert env.task is not None
        pilot.begin(env.task.goal, map_center=(0.0, 0.0))
        for _ in range(30):
            np.testing.assert_allclose(pilot.observe(*sense(env)), seen, rtol=0, atol=1e-6)
            seen, _, ended, _, _ = env.step(rng.uniform(-0.2, 1.0, 2))
            if ended:
                break
    env.close()


@pytest.mark.parametrize(("latency", "memory"), [(0.1, "none"), (0.26, "map")])
def test_with_late_orders_it_senses_what_the_environment_senses(
    tmp_path: Path, latency: float, memory: str
) -> None:
    arguments: dict[str, Any] = {"robot": "kobuki", "memory": memory, "latency": latency}
    arguments |= {"closeness_distance": 0.23, "physics": "kinematic", "time_step": 0.02}
    arguments |= {"action_repeat": 10}
    pilot = Pilot.load(exported(tmp_path, size_of(arguments), **arguments), latency=latency)
    env = NavigationEnv(world="C", **arguments)
    rng, robot = np.random.default_rng(0), env.config.robot
    seen, _ = env.reset(seed=2)
    assert env.task is not None
    pilot.begin(env.task.goal, map_center=(0.0, 0.0))
    for step in range(25):
        mine = pilot.observe(*sense(env), time=0.2 * step)
        np.testing.assert_allclose(mine, seen, rtol=0, atol=1e-5)
        action = rng.uniform(-0.2, 0.8, 2).astype(np.float32)
        left, right = robot.wheel_speeds(action)
        pilot.give(0.2 * step, 0.5 * (left + right), (right - left) / robot.wheel_base)
        seen, _, ended, _, _ = env.step(action)
        if ended:
            break
    assert step > 10
    env.close()


def test_a_robot_that_stands_still_drives_back_to_where_it_came_from() -> None:
    facts = card(robot=KOBUKI, sectors=36, field_of_view=360.0, observation_size=42)
    pilot = Pilot(facts, lambda _: np.zeros((1, 2), np.float32), clearance=0.03)
    pilot.begin((4.0, 0.0))
    free, ordered = Scan(-math.pi, math.pi / 180, np.full(360, 2.0)), []
    for step in range(80):
        x = min(0.1 * step, 1.0)
        ordered.append(pilot.decide(free, (x, 0.0, 0.0), (0.0, 0.0)).linear)
    # It has stood for ten seconds from the second decision on that is within 0.1 m of the last.
    backs = [step for step, speed in enumerate(ordered) if speed < -0.1]
    assert backs[0] == 9 + 50 and backs == list(range(59, 80))
    assert pilot.stands_still and max(map(abs, ordered[:59])) == 0.0
    # Once it is half a meter away the policy decides.
    assert pilot.decide(free, (0.55, 0.0, 0.0), (0.0, 0.0)).linear == 0.0


def test_a_robot_that_stands_still_near_its_start_drives_back_there() -> None:
    facts = card(robot=KOBUKI, sectors=36, field_of_view=360.0, observation_size=42)
    pilot = Pilot(facts, lambda _: np.zeros((1, 2), np.float32), clearance=0.03)
    pilot.begin((4.0, 0.0))
    free, xs = Scan(-math.pi, math.pi / 180, np.full(360, 2.0)), [0.0, 0.15, *[0.3] * 60]
    ordered = [pilot.decide(free, (x, 0.0, 0.0), (0.0, 0.0)).linear for x in xs]
    assert min(ordered[:50]) == 0.0 and ordered[-1] < -0.1


def test_a_command_is_the_action_as_wheel_speeds_and_twist(tmp_path: Path) -> None:
    file = exported(tmp_path)
    pilot, policy = Pilot.load(file), mpfa_envs.load_policy(file)
    env = NavigationEnv(world="C", closeness_distance=0.23, physics="kinematic")
    seen, _ = env.reset(seed=3)
    assert env.task is not None
    pilot.begin(env.task.goal)
    command = pilot.decide(*sense(env))
    left, right = env.config.robot.wheel_speeds(policy(seen))
    assert command[:2] == pytest.approx((left, right))
    assert command[2:] == pytest.approx(((left + right) / 2, (right - left) / 0.23))


def test_a_slower_robot_drives_the_same_arcs_more_slowly(tmp_path: Path) -> None:
    file = exported(tmp_path)
    fast, slow = Pilot.load(file), Pilot.load(file, robot="burger")
    pace = 0.22 / 0.5
    assert slow.pace == pytest.approx(pace) and slow.period == pytest.approx(0.2 / pace)
    scan = Scan(-math.pi, math.pi / 180, np.full(360, 2.0))
    for pilot in (fast, slow):
        pilot.begin((3.0, 0.5))
    want = fast.decide(scan, (0.0, 0.0, 0.1), (0.3, 0.5))
    found = slow.decide(scan, (0.0, 0.0, 0.1), (0.3 * pace, 0.5 * pace))
    assert found[2:] == pytest.approx((pace * want.linear, pace * want.angular), rel=1e-5)
    assert (found.right - found.left) / 0.16 == pytest.approx(found.angular)


def test_a_new_goal_clears_the_map_unlike_a_moved_one(tmp_path: Path) -> None:
    pilot = Pilot.load(exported(tmp_path, 27, memory="map"))
    ahead = Scan(-math.pi / 2, math.pi / 90, np.full(91, 1.0))
    free = Scan(-math.pi / 2, math.pi / 90, np.full(91, math.inf))
    still = (0.0, 0.0, 0.0), (0.0, 0.0)
    pilot.begin((4.0, 0.0))
    around = pilot.observe(ahead, *still)[26]
    assert around > 0.5  # A half circle of walls, 1 m away, is ahead.
    assert pilot.observe(free, *still)[26] == around
    pilot.move_goal((-4.0, 0.0))
    behind = pilot.observe(free, *still)
    assert behind[24] == pytest.approx(-1.0, abs=0.1) and behind[26] == pytest.approx(0.4)
    pilot.begin((4.0, 0.0))
    assert pilot.observe(free, *still)[26] == pytest.approx(0.4)


def test_a_goal_beyond_a_known_map_is_rejected(tmp_path: Path) -> None:
    pilot = Pilot.load(exported(tmp_path, 27, memory="map"), map_size=10.0)
    free = Scan(-math.pi / 2, math.pi / 90, np.full(91, math.inf))
    rejected = r"goal must be on the map, 10 m \(map_size\) around \(1.00, 0.00\), got "
    with pytest.raises(ValueError, match=rejected + r"\(6.10, 0.00\)"):
        pilot.begin((6.1, 0.0), map_center=(1.0, 0.0))
    assert pilot.goal is None
    pilot.begin((6.1, 0.0))
    for _ in range(2):
        with pytest.raises(ValueError, match=rejected):
            pilot.decide(free, (1.0, 0.0, 0.0), (0.0, 0.0))
    pilot.begin((5.9, 0.0))
    pilot.decide(free, (1.0, 0.0, 0.0), (0.0, 0.0))
    with pytest.raises(ValueError, match=rejected + r"\(0.00, -5.10\)"):
        pilot.move_goal((0.0, -5.1))
    assert pilot.goal == (5.9, 0.0)
    pilot.decide(free, (4.0, 0.0, 0.0), (0.0, 0.0))  # The map stays where it began.
    without = Pilot.load(exported(tmp_path), map_size=10.0)
    without.begin((60.0, 0.0))
    without.decide(free, (1.0, 0.0, 0.0), (0.0, 0.0))


def own_robot(wheel_base: float, slowest: float) -> RobotModel:
    return RobotModel(
        name="own", radius=0.18, height=0.3, mass=5.0, wheel_base=wheel_base, wheel_radius=0.05,
        min_wheel_speed=slowest, max_wheel_speed=0.5,
    )  # fmt: skip


def test_a_robot_too_coarse_for_the_sharpest_arcs_is_rejected() -> None:
    message = "a wheel of own would turn at -0.0557 m/s, its min_wheel_speed is 0.0: train a policy"
    with pytest.raises(CardError, match=message):
        Pilot(card(), lambda _: np.zeros((1, 2), np.float32), robot=own_robot(0.35, 0.0))


def test_it_needs_numpy_and_onnxruntime_alone(tmp_path: Path) -> None:
    file = exported(tmp_path)
    others = ("torch", "torchrl", "tensordict", "gymnasium", "pybullet", "numba", "scipy", "onnx")
    code = f"""
from mpfa_envs.deploy import Pilot, Scan
pilot = Pilot.load({str(file)!r})
pilot.begin((3.0, 1.0))
print(pilot.decide(Scan(-3.1, 0.01, [2.0] * 620), (0.0, 0.0, 0.0), (0.0, 0.0)))
"""
    found = run(code, without=(*others, "yaml", "PIL"), PYTHONWARNINGS="error")
    assert found.startswith("Command(left=0.")


def test_bad_numbers_are_rejected_by_name(tmp_path: Path) -> None:
    pilot = Pilot.load(exported(tmp_path))
    scan, still = Scan(-2.0, 0.01, np.ones(400)), ((0.0, 0.0, 0.0), (0.0, 0.0))
    with pytest.raises(ValueError, match="goal must be given to begin"):
        pilot.decide(scan, *still)
    with pytest.raises(ValueError, match="goal must be a finite number, got nan"):
        pilot.begin((math.nan, 0.0))
    pilot.begin((1.0, 0.0))
    with pytest.raises(ValueError, match="pose must be a finite number, got nan"):
        pilot.decide(scan, (0.0, math.nan, 0.0), (0.0, 0.0))
    with pytest.raises(ValueError, match=r"pose must be within 1e\+07 m of the origin, got \(-1"):
        pilot.decide(scan, (-1e8, 0.0, 0.0), (0.0, 0.0))
    with pytest.raises(ValueError, match="speeds must be a finite number, got inf"):
        pilot.decide(scan, (0.0, 0.0, 0.0), (math.inf, 0.0))
    broken = Pilot(pilot.card, lambda seen: np.full((1, 2), np.nan, np.float32))
    broken.begin((1.0, 0.0))
    with pytest.raises(ValueError, match="the network's action must be finite"):
        broken.decide(scan, *still)


def test_a_network_of_another_size_is_rejected(tmp_path: Path) -> None:
    from mpfa_envs.deploy import Network

    _, content = read_exported(exported(tmp_path))
    with pytest.raises(CardError, match="the network must map"):
        Network(content, 25, 2)
    with pytest.raises(CardError, match="holds no network"):
        Network(b"nothing", 24, 2)
    with pytest.raises(CardError, match="the card has no 'format'"):
        Card.of({})


def in_place(card: Card, slowest: float) -> Pilot:
    """A pilot of a robot that sees 80 degrees and is ordered to turn."""
    robot = replace(card.robot, min_wheel_speed=slowest)
    turn = np.array([[1.0, 0.2]], np.float32)
    return Pilot(replace(card, robot=robot), lambda _: turn, unseen=0.3)


@pytest.mark.parametrize("slowest", [0.0, 0.05])
def test_a_wheel_is_not_ordered_below_its_least_speed(slowest: float) -> None:
    pilot = in_place(card(), slowest)
    pilot.begin((3.0, 1.0))
    scan = Scan(-math.radians(40.0), math.radians(1.0), np.full(81, 3.0), 0.1, 5.0)
    with pytest.raises(ScanError, match="it cannot turn on the spot"):
        pilot.decide(scan, (0.0, 0.0, 0.0), (0.1, 0.0))
    able = in_place(card(), -0.5)
    able.begin((3.0, 1.0))
    command = able.decide(scan, (0.0, 0.0, 0.0), (0.1, 0.0))
    assert command.linear == 0.0 and command.left == -command.right


@pytest.mark.parametrize("facts", [{}, {"memory": "map", "observation_size": 27}])
@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        ({"ranges": [None] * 360}, ScanError, "ranges must be real numbers, got"),
        ({"ranges": [*[1.0] * 359, "2"]}, ScanError, "ranges must be real numbers, got"),
        ({"angle_increment": None}, ScanError, "angle_increment must be a real number, got None"),
        ({"time": "now"}, ValueError, "time must be a finite number, got 'now'"),
        ({"age": math.nan}, ValueError, "age must be a finite number, got nan"),
    ],
)
def test_a_decision_by_what_is_no_number_is_rejected_by_name(
    facts: dict[str, Any], wrong: dict[str, Any], error: type[ValueError], message: str
) -> None:
    pilot = Pilot(card(**facts), lambda seen: np.ones((1, 2), np.float32))
    scan = Scan(-math.pi, math.pi / 180, [3.0] * 360)
    times = {name: wrong[name] for name in ("time", "age") if name in wrong}
    wrong = {name: wrong[name] for name in wrong if name not in times}
    pilot.begin((3.0, 0.0))
    with pytest.raises(error, match=f"^{message}"):
        pilot.decide(scan._replace(**wrong), (0.0, 0.0, 0.0), (0.0, 0.0), **times)
    assert pilot.decide(scan, (0.0, 0.0, 0.0), (0.0, 0.0)).linear > 0.0
