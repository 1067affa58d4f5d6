"""Episodes with another goal, beside those that the environment itself makes for that goal."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from mpfa_envs import GoalRelabeling, NavigationTorchEnv, RewardTerms, TaskConfig

KEPT = ("observation", "action", "hindsight", "next")
OF_A_STEP = ("observation", "action", ("next", "observation"), ("next", "reward"))


def make_env(**task):
    task = {"progress": "none", "physics": "kinematic", "min_goal_distance": 0.51, **task}
    return NavigationTorchEnv(hindsight=True, detour_chance=0.0, **task)


def drive(env, *, seed, start=None, goal=None, actions=None):
    """One episode, of given actions or of ones that wander, and its world and task."""
    env.set_seed(seed)
    state = env.reset()
    world, task = env.env.worlds[0], env.env.tasks[0]
    rng, steps, action = np.random.default_rng(seed), [], np.zeros(2)
    while True:
        action = np.clip(0.8 * action + 0.5 * rng.normal(size=2) + 0.15, -1, 1)
        given = action if actions is None else actions[len(steps)]
        state["action"] = torch.as_tensor(given, dtype=torch.float32)
        state = env.step(state)
        steps.append(state.select(*KEPT).clone())
        if state["next", "done"] or (actions is not None and len(steps) == len(actions)):
            return torch.stack(steps), world, task
        state = state["next"].exclude("reward").clone()


@pytest.mark.parametrize("memory", ["none", "map"])
def test_rows_of_another_goal_are_those_of_an_environment_that_has_it(memory):
    task = {"memory": memory, "max_steps": 240, "action_repeat": 1}
    env, compared = make_env(world="mixed", **task), 0
    for seed in (1, 2, 4):
        episode, world, own = drive(env, seed=seed)
        for step in range(12, len(episode), 17):
            rows = GoalRelabeling(env.env.config)(episode, torch.tensor([step]))
            if not len(rows):
                continue
            other = make_env(world=world, **task)
            goal = episode["next", "hindsight"][step, :2].tolist()
            other.set_task(own.start, goal, world=world)
            found, *_ = drive(other, seed=0, actions=rows["action"].numpy())
            assert len(found) == len(rows)
            ends = [("next", name) for name in ("done", "terminated", "truncated")]
            for key in (*OF_A_STEP, *ends):
                assert torch.equal(found[key], rows[key]), (step, key)
            assert rows["next", "terminated"].sum() == rows["next", "terminated"][-1] == 1
            compared += 1
    assert compared >= 5


@pytest.mark.parametrize(
    "task",
    [
        {"world": "mixed", "memory": "map", "noise": {"range_noise": 0.02, "dropout": 0.05}},
        {"world": "mixed", "memory": "map", "noise": {"drift": 0.1, "slip": 0.1}, "latency": 0.15},
        {"world": "crowd", "memory": "map", "history": 2},
        {"world": "mixed", "robot": "burger", "lidar": {"reduction": "median"}},
    ],
    ids=["lidar", "odometry", "walkers", "robot"],
)
def test_the_episode_s_own_goal_changes_nothing_whatever_the_noise(task):
    env, compared = make_env(max_steps=60, **task), 0
    for seed in range(6):
        episode, _, own = drive(env, seed=seed)
        if episode["next", "terminated"].any():
            continue
        # As if the last action had carried the robot to its goal, which it did not see.
        episode["next", "hindsight"][-1, :2] = torch.tensor(own.goal, dtype=torch.double)
        rows = GoalRelabeling(env.env.config)(episode, torch.tensor([len(episode) - 1]))
        for key in ("observation", "action", ("next", "observation")):
            assert torch.equal(rows[key], episode[key]), key
        assert torch.equal(rows["next", "reward"][:-1], episode["next", "reward"][:-1])
        compared += 1
    assert compared


def episode_along(places):
    """An episode of a robot that was at these places [m] on a line, ``T + 1`` of them."""
    moments = torch.zeros(len(places), 9 + 54, dtype=torch.double)
    moments[:, 0] = moments[:, 4] = torch.tensor(places)
    moments[:, 2:4] = 10.0
    moments[:, 9:] = 3.0
    count = len(places) - 1
    no = torch.zeros(count, 1, dtype=torch.bool)
    ended = no.clone()
    ended[-1] = True
    after = {
        "observation": torch.zeros(count, 24),
        "hindsight": moments[1:],
        "reward": torch.full((count, 1), -0.1),
        "done": ended,
        "terminated": no.clone(),
        "truncated": ended.clone(),
    }
    before = {"observation": torch.zeros(count, 24), "hindsight": moments[:-1]}
    return TensorDict({**before, "step": torch.arange(count), "next": after}, [count])


def ends_by_hand(places, steps, radius):
    """Length of the episode with each goal, in plain loops; 0: it begins at the goal."""
    ends = []
    for step in steps:
        for number, place in enumerate(places):
            if abs(place - places[step + 1]) <= radius:
                ends.append(number)
                break
    return ends


def test_an_episode_ends_where_the_robot_first_comes_near_the_goal():
    # There and back, and out again: the third place is near the goals before it turns.
    places = [0.0, 0.4, 0.8, 1.3, 0.9, 0.3, -0.6, -1.2, -1.0]
    steps = [0, 2, 4, 5, 6, 7]
    config = TaskConfig(progress="none", physics="kinematic")
    rows = GoalRelabeling(config)(episode_along(places), torch.tensor(steps))
    ends = ends_by_hand(places, steps, config.goal_radius)
    assert ends == [0, 2, 0, 6, 7, 6]
    expected = [number for end in ends for number in range(end)]
    assert rows["step"].tolist() == expected
    last = [number + 1 == end for end in ends for number in range(end)]
    assert rows["next", "terminated"].flatten().tolist() == last
    assert rows["next", "done"].flatten().tolist() == last
    assert not rows["next", "truncated"].any()
    rewards = [10.0 if end else -0.1 for end in last]
    torch.testing.assert_close(rows["next", "reward"].flatten(), torch.tensor(rewards))
    distances = [
        abs(places[step + 1] - places[number]) / 10
        for step, end in zip(steps, ends, strict=True)
        for number in range(end)
    ]
    torch.testing.assert_close(rows["observation"][:, 21], torch.tensor(distances))
    assert "hindsight" not in rows.keys(True)


def test_the_episode_itself_stays_as_it_was():
    episode = episode_along([0.0, 0.7, 1.4])
    before = episode.clone()
    GoalRelabeling(TaskConfig(progress="none"))(episode, torch.tensor([0, 1]))
    assert (episode == before).all()


def test_goals_that_the_robot_began_at_leave_no_rows():
    rows = GoalRelabeling(TaskConfig(progress="none", memory="map"))(
        episode_along([0.0, 0.1, 0.2]), torch.tensor([0, 1])
    )
    assert len(rows) == 0


@pytest.mark.parametrize("progress", ["straight_line", "shortest_path"])
def test_a_reward_for_progress_is_rejected(progress):
    with pytest.raises(ValueError, match=f"progress must be 'none' .*, got '{progress}'"):
        GoalRelabeling(TaskConfig(progress=progress))


def test_a_reward_of_one_s_own_is_rejected():
    with pytest.raises(ValueError, match="reward must be None or navigation_reward"):
        GoalRelabeling(TaskConfig(progress="none", reward=lambda outcome: RewardTerms(goal=1.0)))
