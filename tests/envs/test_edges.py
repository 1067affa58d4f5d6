"""Where one thing ends and the next begins: a reset of some, last steps, exact distances."""

from __future__ import annotations

import numpy as np

from mpfa_envs import Box, NavigationEnv, VectorNavigationEnv, World
from mpfa_envs.worlds.plain import world_to_plain
from tests.envs.paper import drive_to_end, full_speed


def test_a_seed_of_a_reset_seeds_the_robots_that_it_starts() -> None:
    env, twin = (VectorNavigationEnv(2, world="B", physics="kinematic") for _ in range(2))
    first, second = np.array([True, False]), np.array([False, True])
    env.reset(seed=0)
    twin.reset(seed=0)
    env.reset(seed=9, options={"reset_mask": first})
    for each in (env, twin):
        each.reset(options={"reset_mask": second})
    assert env.tasks[1] == twin.tasks[1]
    assert env.tasks[0] != twin.tasks[0]


def test_a_replacement_world_is_kept_for_as_many_episodes() -> None:
    env = VectorNavigationEnv(1, world="clutter", physics="kinematic", episodes_per_world=3)
    env.reset(seed=0)
    state = env.state_dict()
    full = World(name="full", boxes=(Box(-5.0, -5.0, 5.0, 5.0),))
    state["source"].update(worlds=[world_to_plain(full)], left=[1])
    env.load_state_dict(state)
    names = []
    for _ in range(4):
        env.reset()
        names.append(env.worlds[0].name)
    assert len(set(names[:3])) == 1 and names[3] != names[0]


def test_a_goal_reached_in_the_last_step_is_no_timeout() -> None:
    ends = []
    for max_steps in (500, 31, 30):  # The goal is 1.52 m away, and a step is 0.05 m.
        env = NavigationEnv(physics="kinematic", max_steps=max_steps)
        *_, ended, truncated, info = drive_to_end(env, full_speed, goal=(2.02, 0.0))
        ends.append((ended, truncated, info["success"], info["timeout"]))
    assert ends == [(True, False, True, False)] * 2 + [(False, True, False, True)]


def test_a_robot_at_the_very_collision_distance_has_collided() -> None:
    env = NavigationEnv(
        physics="kinematic", time_step=0.125, action_repeat=1, collision_distance=0.25
    )
    # A step is 1/16 m: 12 of them are exact.
    env.reset(options={"start": (4.0, 0.0, 0.0), "goal": (-4.0, 0.0)})
    ended = [env.step([1.0, 1.0])[2] for _ in range(12)]
    assert env.trail[-1] == (4.75, 0.0)
    assert ended == [False] * 11 + [True]
