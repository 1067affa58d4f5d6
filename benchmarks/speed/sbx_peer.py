"""Updates of SBX (Stable-Baselines3 in JAX) in a process of its own, which another one asks for.

    python benchmarks/speed/sbx_peer.py td3 64 update

Each line of the input asks for so many updates, or steps of the whole ``loop`` with an update each;
each line of the output has their CPU time [s]. JAX takes its threads from the processor's cores,
hence a process with a single one. The script imports none of this project, so that SBX may be
installed for another Python.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

OBSERVATION_SIZE = 24
ACTION_SIZE = 2
BATCH_SIZE = 256
CAPACITY = 100_000
FILL = 10_000
UPDATES = 16
"""Updates that are made at once where only updates are measured."""


class IdleEnv(gymnasium.Env[Any, Any]):
    """An environment that does nothing, for Stable-Baselines3 and SBX."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (OBSERVATION_SIZE,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION_SIZE,), np.float32)
    _observation = np.zeros(OBSERVATION_SIZE, dtype=np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Start an episode."""
        super().reset(seed=seed)
        return self._observation, {}

    def step(self, action: Any) -> Any:
        """Do nothing."""
        return self._observation, 0.0, False, False, {}


def make_call(algorithm: str, width: int, part: str) -> Callable[[int], object]:
    """Make a function that takes so many updates, or steps of the whole loop."""
    import sbx
    from stable_baselines3.common.noise import NormalActionNoise

    zeros = np.zeros(ACTION_SIZE)
    model = {"ddpg": sbx.DDPG, "td3": sbx.TD3}[algorithm](
        "MlpPolicy",
        IdleEnv(),
        learning_rate=1e-4,
        qf_learning_rate=1e-4,
        buffer_size=CAPACITY,
        learning_starts=BATCH_SIZE,
        batch_size=BATCH_SIZE,
        tau=0.01,
        action_noise=NormalActionNoise(zeros, zeros + 0.2),
        policy_kwargs={"net_arch": [width, width]},
        seed=0,
    )
    model.learn(2 * BATCH_SIZE)
    random = np.random.default_rng(0)
    for _ in range(FILL if part == "update" else 0):
        seen = random.standard_normal((2, 1, OBSERVATION_SIZE), dtype=np.float32)
        action = random.uniform(-1, 1, (1, ACTION_SIZE)).astype(np.float32)
        end, reward = np.zeros(1), random.standard_normal(1)
        model.replay_buffer.add(seen[0], seen[1], action, reward, end, [{}])
    if part == "update":
        return lambda calls: model.train(calls, BATCH_SIZE)
    return lambda calls: model.learn(calls, reset_num_timesteps=False)


def main() -> None:
    """Serve until the input ends."""
    call = make_call(sys.argv[1], int(sys.argv[2]), sys.argv[3])
    for line in sys.stdin:
        start = time.process_time()
        call(int(line))
        print(time.process_time() - start, flush=True)


if __name__ == "__main__":
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    main()
