"""Greedy evaluations during training, which show how fast a run learns and change nothing in it."""

from __future__ import annotations

import copy
import time
from multiprocessing.connection import Connection

from tensordict.nn import TensorDictModule

from environments import make_evaluation_env
from evaluation import greedy, run_episodes
from mpfa_envs import evaluation_pairs
from process import Companion
from records import ProgressRecord
from settings import TrainSettings

_PAIRS_SEED = 1


def evaluate_progress(
    settings: TrainSettings, policy: TensorDictModule, *, total_steps: int, episode: int
) -> ProgressRecord:
    """Drive the fixed pairs of the validation map, or of another map that the settings name.

    Args:
        settings: Of the run.
        policy: The policy as it is now.
        total_steps: Actions so far.
        episode: Episodes so far.

    Returns:
        Rates of success, collision and timeout, and the mean SPL.
    """
    start = time.perf_counter()
    wanted = settings.evaluation
    env = make_evaluation_env(wanted.world, settings.environment)
    tasks = evaluation_pairs(wanted.world, wanted.episodes, _PAIRS_SEED, robot=env.robot)
    results, _ = run_episodes(env, greedy(policy), tasks, progress=False)
    env.close()
    names = ("success", "collision", "timeout", "spl")
    return ProgressRecord(
        total_steps=total_steps,
        episode=episode,
        world=wanted.world,
        seconds=time.perf_counter() - start,
        **{name: sum(getattr(r, name) for r in results) / len(results) for name in names},
    )


class Progress:
    """The evaluations of a run, between two episodes or in a process beside it.

    Args:
        settings: Of the run; with ``overlap`` there is a process, once it has something to do.
    """

    def __init__(self, settings: TrainSettings) -> None:
        self.settings = settings
        self._companion: Companion | None = None
        self._finished: list[ProgressRecord] = []
        self._under_way = 0

    def start(self, policy: TensorDictModule, *, total_steps: int, episode: int) -> None:
        """Evaluate the policy as it is now."""
        if not self.settings.overlap:
            record = evaluate_progress(
                self.settings, policy, total_steps=total_steps, episode=episode
            )
            self._finished.append(record)
            return
        if self._companion is None:
            self._companion = Companion("evaluation", _evaluate, self.settings)
        self._companion.send((copy.deepcopy(policy).to("cpu"), total_steps, episode))
        self._under_way += 1

    def finished(self, *, wait: bool = False) -> list[ProgressRecord]:
        """Take what was found since the last call.

        Args:
            wait: Whether to wait for evaluations that are under way.

        Returns:
            The records, in the order of their steps.
        """
        while self._companion is not None and self._under_way:
            if not (wait or self._companion.has_answered()):
                break
            self._finished.append(self._companion.receive())
            self._under_way -= 1
        found, self._finished = self._finished, []
        return found

    def close(self) -> None:
        """End the process, if there is one."""
        if self._companion is not None:
            self._companion.close()


def _evaluate(connection: Connection, settings: TrainSettings) -> None:
    """Serve a :class:`Progress`: told a policy and when it is from, answer with a record."""
    while True:
        policy, total_steps, episode = connection.recv()
        connection.send(
            evaluate_progress(settings, policy, total_steps=total_steps, episode=episode)
        )
