"""Comparisons: the runs of several methods, learners, arms and seeds, their settings and rows."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from mpfa_envs import load_policy
from torchrl_mpfa.saving import write_text_atomically
from training import files
from training.comparison.arms import PLAIN, Arm, with_defaults
from training.evaluating import Conditions, needs_filter
from training.finished import is_finished, read_json
from training.options import EPISODES, WORLDS
from training.plugins import plugin_words
from training.records import read_table, write_table
from training.settings.command_line import composed
from training.settings.environment import EnvironmentSettings
from training.settings.resuming import LAWFUL, OF_THE_CALL
from training.settings.rules import named, settings_by_name
from training.settings.train import TrainSettings, as_settings

SCRIPTS = Path(__file__).resolve().parents[2]
_OF_THE_RESULT = ("evaluation.every",)
"""Settings that a resumed run may change, but that change its result."""
_FREE = {*LAWFUL, *OF_THE_CALL, "device", "threads"} - {*_OF_THE_RESULT}
"""Settings that may differ from those that a comparison asks for."""


def run_name(learner: str, method: str, arm: str, seed: int) -> str:
    """Name of a run, and of its folder; an arm without a name is left out."""
    return "-".join(part for part in (learner, method, arm, str(seed)) if part)


@dataclass(frozen=True)
class Evaluation:
    """The evaluation of every policy of a comparison."""

    words: tuple[str, ...]
    """Worlds, as on the command line."""
    episodes: int
    """Pairs of start and goal in each of them."""
    physics: str | None = None
    """``wheels`` or ``kinematic``; None: as trained."""
    filtered: bool | None = None
    """True if actions pass the filter; None: those of policies that need it."""
    plugin: str | None = None
    """Path of the plugin."""


TESTED = Evaluation(WORLDS, EPISODES)
"""Evaluation by ``compare.py`` unless its command line names another."""


@dataclass(frozen=True)
class Job:
    """One run of a comparison."""

    learner: str
    method: str
    seed: int
    folder: Path
    """Folder of the comparison."""
    arm: Arm = PLAIN

    @property
    def name(self) -> str:
        """Name of the run, and of its folder."""
        return run_name(self.learner, self.method, self.arm.name, self.seed)

    @property
    def path(self) -> Path:
        """Folder of the run."""
        return self.folder / self.name

    def overrides(self, overrides: Sequence[str]) -> list[str]:
        """Return its settings as on the command line of ``train.py``."""
        own = [f"learner={self.learner}", f"method={self.method}", f"seed={self.seed}"]
        # The runs that differ by their seeds alone are one group in wandb.
        group = f"{self.folder.name}/{self.name.removesuffix(f'-{self.seed}')}"
        own += [f"run_dir={self.path}", f"tracking.group={files.short_name(group, 128)}"]
        return [*own, *with_defaults(self.arm.over(overrides))]

    def asked(self, overrides: Sequence[str]) -> TrainSettings:
        """Return its settings."""
        with named(f"--arm {self.arm.name}: " if self.arm.name else ""):
            first, *others = composed(self.overrides(overrides))
        if others:
            raise ValueError("a comparison takes one value for each setting, not a sweep")
        return first

    def trains(self, overrides: Sequence[str], *, anew: bool = False) -> list[str]:
        """Return the command that trains the run, or resumes it from its checkpoint."""
        script = [str(SCRIPTS / "train.py")]
        if (self.path / files.CHECKPOINT).exists() and not anew:
            return [*script, f"resume={self.path}", *plugin_words(self.overrides(overrides))]
        return [*script, *self.overrides(overrides), "overwrite=true"]

    def evaluates(self, wanted: Evaluation) -> list[str]:
        """Return the command that evaluates its policy."""
        return [
            *(str(SCRIPTS / "evaluate.py"), str(self.path)),
            *("--worlds", *wanted.words, "--episodes", str(wanted.episodes), "--no-pictures"),
            *(["--physics", wanted.physics] if wanted.physics else []),
            *(
                []
                if wanted.filtered is None
                else ["--filter" if wanted.filtered else "--no-filter"]
            ),
            *(["--plugin", wanted.plugin] if wanted.plugin else []),
        ]

    def physics(self, wanted: Evaluation) -> str:
        """Return the physics of its evaluation: ``wheels`` or ``kinematic``."""
        if wanted.physics is not None:
            return wanted.physics
        trained = read_json(self.path / files.SETTINGS).get("environment", {})
        return str(trained.get("physics", EnvironmentSettings.physics))

    def filtered(self, wanted: Evaluation) -> bool:
        """Return True if its evaluation has the filter: if asked for, or if its policy needs it."""
        if wanted.filtered is not None:
            return wanted.filtered
        return (self.path / files.POLICY).exists() and needs_filter(load_policy(self.path))

    def conditions(self, wanted: Evaluation) -> Conditions:
        """Return those of its evaluation: pairs of the first seed, robots without errors."""
        physics, filtered = self.physics(wanted), self.filtered(wanted)
        return Conditions(wanted.words, physics, wanted.episodes, filtered=filtered)

    def results(self, wanted: Evaluation) -> Path:
        """Return the folder of its evaluation."""
        return self.path / self.conditions(wanted).folder

    def status(self) -> Mapping[str, Any]:
        """Return its progress; empty before its first episode."""
        return read_json(self.path / files.STATUS)

    def is_trained(self) -> bool:
        """Return True if the run is finished and its policy and episodes are there."""
        return is_finished(self.path)

    def is_evaluated(self, wanted: Evaluation) -> bool:
        """Return True if its present policy was evaluated as wanted."""
        evaluated, policy = (
            read_json(self.results(wanted) / files.SETTINGS),
            self.path / files.POLICY,
        )
        return (
            self.is_trained()
            and self.conditions(wanted).are_of(evaluated)
            and policy.exists()
            and evaluated.get("sha256") == files.digest(policy)
        )

    def differences(self, asked: TrainSettings) -> list[str]:
        """Return the settings that differ from those asked for."""
        found = dict(read_json(self.path / files.SETTINGS))
        if not found:
            return []
        if found.pop("plugin_sha256", None) != files.digest_of(asked.plugin):
            return ["another plugin than the present one"]
        had, wanted = (dict(settings_by_name(each)) for each in (as_settings(found), asked))
        return [
            f"{name}={had[name]}, asked for is {value}"
            for name, value in wanted.items()
            if name not in _FREE and had[name] != value
        ]


@dataclass(frozen=True)
class Comparison:
    """Runs that one command of ``compare.py`` makes: each learner, method, arm and seed."""

    folder: Path
    methods: tuple[str, ...]
    settings: tuple[str, ...]
    """As on the command line of ``train.py``."""
    seeds: Sequence[int]
    learners: tuple[str, ...] = ("ddpg",)
    arms: tuple[Arm, ...] = (PLAIN,)
    evaluation: Evaluation = TESTED

    @property
    def jobs(self) -> list[Job]:
        """Its runs, in the order in which they are made."""
        return [
            Job(learner, method, seed, self.folder, arm)
            # Seeds outside: a comparison that is cut short has as much of each method.
            for seed in self.seeds
            for learner in self.learners
            for method in self.methods
            for arm in self.arms
        ]


def other_than_asked(jobs: Sequence[Job], overrides: Sequence[str]) -> dict[Job, list[str]]:
    """Return the runs whose settings differ from those asked for."""
    asked: dict[tuple[str, str, Arm], TrainSettings] = {}
    others = {}
    for job in jobs:
        # Settings are checked in their worlds, which takes a second: once for all seeds.
        kind = job.learner, job.method, job.arm
        if kind not in asked:
            asked[kind] = job.asked(overrides)
        found = job.differences(replace(asked[kind], seed=job.seed))
        if found:
            others[job] = found
    return others


def collect(jobs: Sequence[Job], wanted: Evaluation, folder: Path) -> None:
    """Write the rows of all evaluated runs in one file, and their settings in another."""
    tables, settings = [], {}
    for job in jobs:
        if job.is_evaluated(wanted):
            table = read_table(job.results(wanted) / files.EPISODES)
            table.insert(0, "learner", job.learner)
            table.insert(1, "method", job.method)
            table.insert(2, "arm", job.arm.name)
            table.insert(3, "seed", job.seed)
            settings[job.name] = read_json(job.path / files.SETTINGS)
            table.insert(4, "physics", table.pop("physics"))
            tables.append(table)
    if tables:
        write_table(pd.concat(tables), folder / files.EPISODES)
    document = {
        "worlds": wanted.words,
        "episodes": wanted.episodes,
        "physics": wanted.physics,
        "filter": wanted.filtered,
        "runs": settings,
    }
    write_text_atomically(json.dumps(document, indent=2) + "\n", folder / files.SETTINGS)
