"""Sensors beside the lidar, and rewards by name."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mpfa_envs import (
    REWARDS,
    SENSORS,
    WORLDS,
    Lidar,
    LidarSensor,
    Mirror,
    NavigationEnv,
    Policy,
    RewardTerms,
    Sight,
    StepOutcome,
    TaskConfig,
    VectorNavigationEnv,
    export_policy,
    load_policy,
    save_policy,
)
from mpfa_envs.deploy.card import CardError
from mpfa_envs.policies.layers import Linear
from mpfa_envs.sensing.sensors import describe_sensors, resolve_sensors

TASK: dict[str, Any] = {"physics": "kinematic", "robot": "kobuki"}
REAR = LidarSensor(mount=(-0.1, 0.05, 180.0), sectors=6, field_of_view=120.0)
SIZE = TaskConfig(**TASK).observation_slices["angular_speed"].stop


@dataclass
class Bearing:
    """A compass: the heading of each robot, or what a broken one gives."""

    width: int = 1
    bounds: tuple[float, float] = (-4.0, 4.0)
    mirrored: Any = None
    factor: float = 1.0

    def sense(self, sight: Sight) -> NDArray[np.float64]:
        return self.factor * sight.motions[:, 2:3]


@pytest.mark.parametrize("angle", [180.0, 70.0])
def test_a_second_lidar_sees_what_a_lidar_there_would(angle: float) -> None:
    sensor = LidarSensor(mount=(-0.1, 0.05, angle), sectors=6, field_of_view=120.0)
    env = VectorNavigationEnv(3, world="D", sensors={"rear": sensor}, **TASK)
    plain = VectorNavigationEnv(3, world="D", **TASK)
    seen, _ = env.reset(seed=3)
    before, _ = plain.reset(seed=3)
    lidar = Lidar(WORLDS["D"], sectors=6, field_of_view=120.0)
    for _ in range(6):
        np.testing.assert_array_equal(seen[:, :SIZE], before)
        for row, (x, y, heading) in zip(seen, env.poses, strict=True):
            ahead, left = -0.1, 0.05
            x += ahead * np.cos(heading) - left * np.sin(heading)
            y += ahead * np.sin(heading) + left * np.cos(heading)
            ranges = lidar.scan(x, y, heading + np.radians(angle))
            expected = 0.25 / np.maximum(ranges, 0.25)
            np.testing.assert_allclose(row[SIZE:], expected, atol=1e-6)
        seen = env.step(np.full((3, 2), 0.8, np.float32))[0]
        before = plain.step(np.full((3, 2), 0.8, np.float32))[0]
    assert env.single_observation_space.contains(seen[0])


def test_parts_of_sensors_follow_earlier_scans_and_maps() -> None:
    sensors: Any = {"rear": REAR, "bearing": Bearing()}
    config = TaskConfig(history=2, memory="map", sensors=sensors, **TASK)
    own = TaskConfig(history=2, memory="map", **TASK).observation_slices
    last = max(part.stop for part in own.values())
    parts = config.observation_slices
    assert (parts["rear"], parts["bearing"]) == (slice(last, last + 6), slice(last + 6, last + 7))
    env = VectorNavigationEnv(2, world="A", history=2, memory="map", sensors=sensors, **TASK)
    plain = VectorNavigationEnv(2, world="A", history=2, memory="map", **TASK)
    seen, before = env.reset(seed=0)[0], plain.reset(seed=0)[0]
    for _ in range(3):
        np.testing.assert_array_equal(seen[:, :last], before)
        np.testing.assert_allclose(seen[:, -1], env.poses[:, 2], rtol=1e-6)
        seen, before = (each.step(np.ones((2, 2), np.float32))[0] for each in (env, plain))


def test_noise_of_a_sensor_is_the_same_in_a_state_that_is_loaded() -> None:
    noisy: Any = {"rear": LidarSensor(noise=0.05, dropout=0.1)}
    env = VectorNavigationEnv(2, world="A", sensors=noisy, **TASK)
    env.reset(seed=0)
    env.step(np.ones((2, 2), np.float32))
    other = VectorNavigationEnv(2, world="A", sensors=noisy, **TASK)
    other.load_state_dict(env.state_dict())
    first, second = (each.step(np.ones((2, 2), np.float32))[0] for each in (env, other))
    np.testing.assert_array_equal(first, second)
    turned: Any = {"rear": LidarSensor(noise=0.05, dropout=0.1, mount=(0.0, 0.0, 90.0))}
    with pytest.raises(ValueError, match="sensors"):
        VectorNavigationEnv(2, world="A", sensors=turned, **TASK).load_state_dict(env.state_dict())
    with pytest.raises(ValueError, match="sensors"):
        VectorNavigationEnv(2, world="A", **TASK).load_state_dict(env.state_dict())


def test_the_filter_and_the_mirror_of_a_task_take_its_observations() -> None:
    ahead = LidarSensor(mount=(-0.1, 0.0, 180.0), sectors=4, field_of_view=90.0)
    config = TaskConfig(sensors={"rear": ahead}, **TASK)
    plain = TaskConfig(**TASK)
    env = NavigationEnv(world="D", sensors={"rear": ahead}, **TASK)
    seen, _ = env.reset(seed=1)
    kept = config.make_filter()(seen, np.ones(2, np.float32))
    np.testing.assert_array_equal(kept, plain.make_filter()(seen[:-4], np.ones(2, np.float32)))
    with pytest.raises(ValueError, match="observation must have shape"):
        plain.make_filter()(seen, np.ones(2, np.float32))
    mirror = Mirror(sectors=36, further=ahead.mirrored or ())
    image = mirror.observation(torch.from_numpy(seen))
    assert image[-4:].tolist() == seen[:-5:-1].tolist()
    assert (
        image[:-4].tolist() == Mirror(sectors=36).observation(torch.from_numpy(seen[:-4])).tolist()
    )
    with pytest.raises(ValueError, match="mirror must be False with the sensor 'rear'"):
        TaskConfig(sensors={"rear": REAR}, **TASK).make_mirror()


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        ("rear", "names in SENSORS.*got 'rear'"),
        ({"rear": LidarSensor}, "must have width, bounds, mirrored and sense"),
        ({"lidar": REAR}, "names of their own, got 'lidar'"),
        ({"it": Bearing(width=0)}, "width must be"),
        ({"it": Bearing(bounds=(1.0, 1.0))}, "bounds must rise"),
        ({"it": Bearing(mirrored=[1])}, "each place once"),
        ({"it": Bearing(mirrored=5)}, "each place once"),
        ({"it": Bearing(bounds=(0.0, 1.0, 2.0))}, "the least and the greatest"),  # type: ignore[arg-type]
        (REAR, "objects by name"),
        (5, "objects by name"),
        ([REAR], "objects by name"),
        ({1: REAR}, "text as names"),
        (["known", "known"], "named once each"),
    ],
)
def test_sensors_that_cannot_be_are_rejected(sensors: Any, message: str) -> None:
    SENSORS["known"] = REAR
    with pytest.raises(ValueError, match=message):
        TaskConfig(sensors=sensors, **TASK)


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        (Bearing(width=2), r"must give \(1, 2\) values, got \(1, 1\)"),
        (Bearing(factor=1e6), r"values in \[-4, 4\], got"),
        (Bearing(factor=np.nan), r"values in \[-4, 4\], got nan"),
    ],
)
def test_what_a_sensor_gives_is_checked(sensor: Bearing, message: str) -> None:
    env = VectorNavigationEnv(1, world="A", sensors={"it": sensor}, **TASK)
    with pytest.raises(ValueError, match=message):
        env.reset(seed=0)


@pytest.mark.parametrize("mount", [(0.0, 0.0), (0.0, 0.0, np.nan), 3, "abc"])
def test_a_mount_that_is_none_is_rejected(mount: Any) -> None:
    with pytest.raises(ValueError, match="mount must be"):
        LidarSensor(mount=mount)


def test_names_find_what_was_registered() -> None:
    def bold(outcome: StepOutcome) -> RewardTerms:
        return RewardTerms(other=outcome.linear_speed)

    SENSORS["rear"], REWARDS["bold"] = REAR, bold
    env = VectorNavigationEnv(1, world="A", sensors=["rear"], reward="bold", **TASK)
    env.reset(seed=0)
    seen, rewards, *_ = env.step(np.ones((1, 2), np.float32))
    assert seen.shape == (1, SIZE + REAR.sectors)
    assert rewards[0] > 0.1
    with pytest.raises(ValueError, match=r"REWARDS.*got 'bald' \(did you mean 'bold'\?\)"):
        TaskConfig(reward="bald", **TASK)  # type: ignore[arg-type]


def test_a_policy_with_sensors_is_no_policy_of_a_robot(tmp_path: Any) -> None:
    SENSORS["rear"] = REAR
    layers = [Linear(np.ones((2, SIZE + 6), np.float32), np.zeros(2, np.float32))]
    policy = Policy(layers, env_arguments={"sensors": ["rear"], **TASK})
    with pytest.raises(CardError, match="by its lidar alone, not by rear"):
        export_policy(policy, tmp_path / "policy.onnx")


def policy_with(*sensors: str) -> Policy:
    layers = [Linear(np.ones((2, SIZE + 6), np.float32), np.zeros(2, np.float32))]
    return Policy(layers, env_arguments={"sensors": [*sensors], **TASK})


def test_a_policy_keeps_the_values_of_its_lidar_whatever_has_its_name_later(tmp_path: Any) -> None:
    SENSORS["rear"] = REAR
    save_policy(policy_with("rear"), tmp_path)
    SENSORS["rear"] = LidarSensor(mount=(0.0, 0.0, 0.0), sectors=9)
    loaded = load_policy(tmp_path)
    assert TaskConfig(**loaded.env_arguments).sensors == {"rear": REAR}
    del SENSORS["rear"]
    assert TaskConfig(**loaded.env_arguments).sensors == {"rear": REAR}


def test_a_policy_with_a_sensor_of_your_own_asks_for_the_same_one(tmp_path: Any) -> None:
    SENSORS["it"] = Bearing()
    save_policy(policy_with("it"), tmp_path)
    loaded = load_policy(tmp_path)
    assert TaskConfig(**loaded.env_arguments).sensors == {"it": SENSORS["it"]}
    SENSORS["it"] = Bearing(width=2)
    with pytest.raises(ValueError, match=r"sensors\['it'\].width must be 1, as when .*got 2"):
        TaskConfig(**loaded.env_arguments)
    del SENSORS["it"]
    with pytest.raises(ValueError, match=r"names in SENSORS.*got 'it'.*plugin"):
        TaskConfig(**loaded.env_arguments)


def test_a_class_of_your_own_with_the_name_of_ours_is_not_taken_for_it() -> None:
    own = type("LidarSensor", (Bearing,), {})()
    facts = describe_sensors({"it": own})
    assert facts is not None and facts["it"]["kind"] == "LidarSensor"
    SENSORS["it"] = own
    assert resolve_sensors(facts) == {"it": own}


def test_a_second_lidar_is_as_close_as_its_own_distance_says() -> None:
    env = VectorNavigationEnv(
        2, world="D", sensors={"rear": REAR, "far": replace(REAR, closeness_distance=1.0)}, **TASK
    )
    seen, _ = env.reset(seed=3)
    rear, far = (seen[:, env.config.observation_slices[name]] for name in ("rear", "far"))
    np.testing.assert_allclose(far, np.minimum(4.0 * rear, 1.0), rtol=1e-5)
    assert (far < 1.0).any()


def test_a_reward_senses_after_each_time_step() -> None:
    seen: list[float] = []

    def near(outcome: StepOutcome) -> RewardTerms:
        seen.append(float(outcome.sense("rear").max()))
        return RewardTerms(other=-seen[-1])

    env = VectorNavigationEnv(
        2, world="A", sensors={"rear": REAR, "it": Bearing()}, reward=near, **TASK
    )
    env.reset(seed=0)
    sensed, rewards, *_ = env.step(-np.ones((2, 2), np.float32))
    assert len(seen) == 4
    np.testing.assert_allclose(rewards, [-seen[0] - seen[2], -seen[1] - seen[3]])
    # Where the action ended, the reward and the observation have the same.
    rear = sensed[:, env.config.observation_slices["rear"]]
    np.testing.assert_allclose(rear.max(1), seen[2:])
    assert seen[0] != seen[2]
    other = VectorNavigationEnv(
        1, world="A", reward=lambda outcome: outcome.sense("raer"), sensors={"rear": REAR}, **TASK
    )
    other.reset(seed=0)
    with pytest.raises(ValueError, match=r"'rear'.*got 'raer' \(did you mean 'rear'\?\)"):
        other.step(np.ones((1, 2), np.float32))
    with pytest.raises(ValueError, match="that of a sensor of the task, got 'rear'"):
        StepOutcome(2.0, 1.9, False, False, 1.0, 0.4, 0.0).sense("rear")


def test_rays_of_a_second_lidar_are_noisy_and_drop_out_from_each_robots_own_source() -> None:
    noisy, deaf = replace(REAR, noise=0.2), replace(REAR, dropout=1.0)

    def seen(sensor: LidarSensor, robots: int) -> NDArray[np.float32]:
        env = VectorNavigationEnv(robots, world="D", sensors={"rear": sensor}, **TASK)
        return env.reset(seed=[1, 2][:robots])[0][:, env.config.observation_slices["rear"]]

    plain, disturbed = seen(REAR, 2), seen(noisy, 2)
    off = np.abs(0.25 / disturbed - 0.25 / plain)
    assert 0.0 < off.max() < 1.5
    np.testing.assert_array_equal(disturbed[:1], seen(noisy, 1))
    np.testing.assert_allclose(seen(deaf, 1), 0.25 / REAR.max_range)
