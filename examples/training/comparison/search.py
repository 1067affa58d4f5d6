"""A search of settings: Optuna suggests trials, workers train them, a folder keeps them."""

from __future__ import annotations

import errno
import json
import os
import shlex
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pandas as pd
import yaml
from optuna.distributions import distribution_to_json
from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances
from optuna.trial import FrozenTrial, TrialState, create_trial
from tqdm import tqdm

from torchrl_mpfa.saving import write_text_atomically
from training import files
from training.comparison.arms import Arm
from training.comparison.execution import LOG, Commands, Work, workers_of
from training.comparison.jobs import Job
from training.comparison.ranges import Ranges, as_lines, fixed_settings
from training.comparison.workers import Worker
from training.figures import plot_search
from training.options import JOBS
from training.records import area_under, read_table, write_table
from training.settings.train import TrainSettings

STUDY = "study.db"
BEST = "best.yaml"
TRIALS = "trials.csv"
PICTURE = "search.png"
_MOST_FAILURES = 3
"""Trials that may fail one after another, as others would for the same cause."""
_UNPRUNED_TRIALS, _UNPRUNED_EVALUATIONS = 5, 3
"""The first trials, which are what others are compared with, and the first evaluations of each."""
_BEST_TRIALS = 5
"""Trials at least whose settings are compared with those of all, as PED-ANOVA's authors advise."""


@dataclass(frozen=True)
class Plan:
    """Plan of a search, the same whenever the search resumes."""

    settings: tuple[str, ...]
    """Settings of all trials, as on the command line of ``train.py``."""
    ranges: Ranges
    seeds: tuple[int, ...]
    """A trial is a run with each of them."""
    objective: str = "area"
    """``area`` under the curve of greedy success in validation, or the ``last`` success."""
    sampler_seed: int = 0

    @cached_property
    def fixed(self) -> TrainSettings:
        """The settings of all trials."""
        return fixed_settings(self.settings)

    @cached_property
    def evaluations(self) -> int:
        """Number of evaluations of a trial; 0 if its runs count episodes, and it is not known."""
        actions = sum(stage.actions for stage in self.fixed.curriculum.stages)
        return len(self.seeds) * (actions // self.fixed.evaluation.every)

    def score(self, curves: Sequence[pd.DataFrame]) -> float:
        """Return the mean over the runs of a trial, by their evaluations so far."""
        if self.objective == "last":
            return float(np.mean([curve["success"].iloc[-1] for curve in curves]))
        return float(np.mean([area_under(each["total_steps"], each["success"]) for each in curves]))

    def as_json(self) -> dict[str, Any]:
        """Return what identifies the plan in a folder."""
        ranges = {
            name: json.loads(distribution_to_json(each)) for name, each in self.ranges.items()
        }
        kept: dict[str, Any] = {"settings": sorted(self.settings), "ranges": ranges}
        kept |= {"seeds": self.seeds, "objective": self.objective}
        kept["sampler seed"] = self.sampler_seed
        return dict(json.loads(json.dumps(kept)))

    def sampler(self, number: int) -> optuna.samplers.TPESampler:
        """Return the sampler of a trial; a resumed search suggests what it would have suggested."""
        (seed,) = np.random.SeedSequence((self.sampler_seed, number)).generate_state(1)
        return optuna.samplers.TPESampler(seed=int(seed))


class Trial:
    """The runs of a trial, the same settings with each seed, one after another.

    ``reported`` is the number of evaluations that Optuna has.
    """

    def __init__(
        self,
        trial: optuna.Trial,
        values: Mapping[str, Any],
        plan: Plan,
        folder: Path,
        *,
        reported: int = 0,
    ) -> None:
        self.trial, self.plan = trial, plan
        # An evaluation is known once it is saved.
        saves = f"checkpoint_every={plan.fixed.evaluation.every}"
        lines = (*plan.settings, *as_lines(values), saves)
        texts = dict(line.split("=", 1) for line in lines)
        learner = texts.pop("learner", plan.fixed.learner.name)
        method = texts.pop("method", plan.fixed.method.name)
        arm = Arm(settings=tuple(f"{name}={text}" for name, text in texts.items()))
        self.path = folder / f"trial-{trial.number:04}"
        self.jobs = [Job(learner, method, seed, self.path, arm) for seed in plan.seeds]
        self._reported = reported
        # Whether to prune after the last one may not have been asked any more.
        self._judged = max(reported - 1, 0)

    @property
    def left(self) -> Job | None:
        """First run of the trial that is not at its end."""
        return next((job for job in self.jobs if not job.is_trained()), None)

    def curves(self, most: int | None = None) -> list[pd.DataFrame]:
        """Return the evaluations of its runs; of the first ``most`` only, if given."""
        found = []
        for job in self.jobs:
            table = read_table(job.path / files.EVALUATIONS).iloc[:most]
            most = None if most is None else most - len(table)
            found += [table] * (len(table) > 0)
        return found

    def is_hopeless(self) -> bool:
        """Report new evaluations; return True to prune the trial."""
        for step in range(self._judged + 1, sum(map(len, self.curves())) + 1):
            self._judged = step
            if step > self._reported:
                self.trial.report(self.plan.score(self.curves(step)), step)
            # A trial at its end has cost all that it can.
            if step != self.plan.evaluations and self.trial.should_prune():
                return True
        return False


class Search(Work[Trial]):
    """The trials of a search, so many in all."""

    def __init__(
        self,
        study: optuna.Study,
        plan: Plan,
        folder: Path,
        *,
        trials: int,
        workers: Sequence[Worker],
    ) -> None:
        self.study, self.plan, self.folder, self.trials = study, plan, folder, trials
        known = study.get_trials(deepcopy=False)
        self._asked = len(known)
        waiting = [self._again(each) for each in known if not each.state.is_finished()]
        self.failures = 0
        """Trials that failed, one after another."""
        total, done = max(trials, self._asked), self._asked - len(waiting)
        bar = tqdm(
            desc="trials", total=total, initial=done, unit="trial", smoothing=0, disable=None
        )
        super().__init__(waiting, workers, bar)

    def _again(self, found: FrozenTrial) -> Trial:
        """Resume a trial that was in progress when the search was stopped or killed."""
        self.study.sampler = self.plan.sampler(found.number)
        trial = optuna.Trial(self.study, found._trial_id)
        reported = len(found.intermediate_values)
        return Trial(trial, found.params, self.plan, self.folder, reported=reported)

    def _ask(self) -> Trial:
        """Begin a new trial."""
        self.study.sampler = self.plan.sampler(self._asked)
        self._asked += 1
        trial = self.study.ask(dict(self.plan.ranges))
        return Trial(trial, trial.params, self.plan, self.folder)

    def name_of(self, item: Trial) -> str:
        """Return the name of a trial."""
        return item.path.name

    @property
    def has_more(self) -> bool:
        """True if there is a trial to begin or to resume."""
        new = self._asked < self.trials and self.failures < _MOST_FAILURES
        return bool(self.waiting) or new

    def take(self) -> tuple[Trial, Job, Commands] | None:
        """Return the next trial with a run to make; end those that have none."""
        while self.has_more:
            trial = self.waiting.pop(0) if self.waiting else self._ask()
            job = trial.left
            if job is not None:
                return trial, job, [job.trains(())]
            self._end(trial, TrialState.COMPLETE)
        return None

    def is_hopeless(self, item: Trial) -> bool:
        """Report new evaluations of a trial; return True to prune the trial."""
        return item.is_hopeless()

    def end(self, item: Trial, status: int | None) -> None:
        """Prune or fail a trial, or let it make its next run."""
        if status is None:
            self._end(item, TrialState.PRUNED)
        elif status:
            job = item.left or item.jobs[-1]
            self.fail(item, f"see {job.path / LOG}")
        else:
            self.waiting.insert(0, item)

    def fail(self, item: Trial, why: str) -> None:
        """End a trial that failed."""
        self._end(item, TrialState.FAIL, why)

    def _end(self, trial: Trial, state: TrialState, why: str = "") -> None:
        """Report the end of a trial to Optuna, and keep its settings if they are the best."""
        curves = trial.curves()
        if state == TrialState.COMPLETE and not curves:
            state, why = TrialState.FAIL, "no run was long enough for an evaluation"
        value = self.plan.score(curves) if state == TrialState.COMPLETE else None
        ended = self.study.tell(trial.trial, value, state=state)
        self.failures = self.failures + 1 if state == TrialState.FAIL else 0
        if state == TrialState.FAIL:
            said = f"failed, {why}"
        else:
            # Most of the size of a run is the state to resume it from.
            for job in trial.jobs:
                (job.path / files.CHECKPOINT).unlink(missing_ok=True)
            said = f"{self.plan.objective} {ended.value:.3f}"
        tqdm.write(f"{trial.path.name}: {said}{', pruned' * (state == TrialState.PRUNED)}")
        self.bar.update()
        best = best_of(self.study)
        if best is not None:
            self.bar.set_postfix_str(f"best {best.value:.3f}")
            write_best(best, self.plan, self.folder / BEST)


def run_search(
    plan: Plan, folder: Path, *, trials: int, most: int | None = None, ray: str | None = None
) -> int:
    """Make the missing ones of so many trials, failed and pruned ones included; write the results.

    ``most`` trials go at a time, by default :data:`JOBS`, or on a cluster all. The exit status is 1
    if the last trials failed, 128 and the number of the signal that stopped it.
    """
    with _study(plan, folder) as study:
        left = max(trials - sum(t.state.is_finished() for t in study.get_trials(deepcopy=False)), 0)
        print(f"{trials} trials, {trials - left} of them done, in {folder}")
        most = min(most or (JOBS if ray is None else left), left)
        with workers_of(ray if left else None, most) as workers:
            search = Search(study, plan, folder, trials=trials, workers=workers)
            stop = search.run()
        write_results(study, plan, folder)
        best = best_of(study)
        if best is not None and (others := equals_of(best, study)):
            names = ", ".join(map(str, others))
            print(
                f"trial {best.number} is not better than {names}: all have {plan.objective} "
                f"{best.value:.4f}; the first of them is kept"
            )
    if stop:
        return stop.exit_status
    return int(search.failures > 0)


@contextmanager
def _study(plan: Plan, folder: Path) -> Iterator[optuna.Study]:
    """Hold the study of a folder; no other process can write there."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    file = folder / STUDY
    with files.lock(folder), _room_for(file):
        if not file.exists() and any(folder.glob("trial-*")):
            raise ValueError(f"{folder} has trials, but not their {STUDY}: name another --folder")
        storage = optuna.storages.RDBStorage(f"sqlite:///{file}")
        try:
            study = optuna.create_study(
                storage=storage,
                study_name="tune",
                direction="maximize",
                load_if_exists=True,
                pruner=optuna.pruners.MedianPruner(_UNPRUNED_TRIALS, _UNPRUNED_EVALUATIONS),
            )
            asked = plan.as_json()
            found = study.user_attrs.get("plan", asked)
            for name, value in asked.items():
                if found.get(name) != value:
                    raise ValueError(
                        f"{folder} holds a search with other {name}, {found.get(name)}, asked for "
                        f"is {value}: name another --folder"
                    )
            study.set_user_attr("plan", asked)
            yield study
        finally:
            storage.remove_session()
            storage.engine.dispose()


@contextmanager
def _room_for(study: Path) -> Iterator[None]:
    """Raise ``OSError`` if the disk of a study is full, for which SQLite has its own error."""
    try:
        yield
    except Exception as error:
        cause: BaseException = error
        while cause.__cause__ is not None:
            cause = cause.__cause__
        if not (isinstance(cause, sqlite3.OperationalError) and "disk is full" in str(cause)):
            raise
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(study)) from error


def best_of(study: optuna.Study) -> FrozenTrial | None:
    """Return the complete trial with the highest value."""
    ended = study.get_trials(deepcopy=False, states=[TrialState.COMPLETE])
    return max(ended, key=lambda trial: trial.value or 0.0, default=None)


def equals_of(best: FrozenTrial, study: optuna.Study) -> list[int]:
    """Return the numbers of the other complete trials with the value of the best."""
    ended = study.get_trials(deepcopy=False, states=[TrialState.COMPLETE])
    values = {each.number: each.value for each in ended if each.number != best.number}
    return [number for number, value in values.items() if value == best.value]


def write_best(best: FrozenTrial, plan: Plan, path: Path) -> None:
    """Write settings as a file of ``train.py``."""
    command = shlex.join([f"settings={path}", *plan.settings])
    head = (
        f"# trial {best.number}: {plan.objective} {best.value:.4f} in validation, as trained by\n"
    )
    head += f"#     python examples/train.py {command}\n"
    write_text_atomically(head + yaml.safe_dump(best.params, sort_keys=False), path)


def write_results(study: optuna.Study, plan: Plan, folder: Path) -> None:
    """Write a row for each trial, and a picture of how they went and of what mattered."""
    table = study.trials_dataframe(attrs=("number", "value", "state", "duration", "params"))
    if table.empty:
        return
    table = table.rename(columns=lambda name: name.removeprefix("params_"))
    write_table(table, folder / TRIALS)
    if table["value"].notna().any():
        plot_search(table, _importances(study), folder / PICTURE, objective=plan.objective)


def _importances(study: optuna.Study) -> dict[str, float]:
    """Return the importance of each setting by PED-ANOVA; empty for few trials."""
    # Optuna leaves out pruned trials, but these show what matters: they are not the best.
    trials = study.get_trials(deepcopy=False, states=[TrialState.COMPLETE, TrialState.PRUNED])
    if len(trials) < 2 * _BEST_TRIALS:
        return {}
    whole = optuna.create_study(direction="maximize")
    for each in trials:
        whole.add_trial(
            create_trial(params=each.params, distributions=each.distributions, value=each.value)
        )
    best = PedAnovaImportanceEvaluator(target_quantile=max(0.1, _BEST_TRIALS / len(trials)))
    return get_param_importances(whole, evaluator=best)
