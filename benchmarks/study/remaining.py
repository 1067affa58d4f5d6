"""How far comparisons are: runs that are done, and the time that the others will take."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median

from training import files
from training.comparison.arms import Arm
from training.comparison.jobs import Comparison, Evaluation, Job
from training.records import read_table


def jobs_done(comparison: Comparison) -> list[Job]:
    """Runs of a comparison that are trained and evaluated."""
    return [job for job in comparison.jobs if job.is_evaluated(comparison.evaluation)]


def free_checkpoints(comparison: Comparison) -> None:
    """Remove the checkpoints of runs that are done: thousands of them fill a disk."""
    for job in jobs_done(comparison):
        (job.path / files.CHECKPOINT).unlink(missing_ok=True)


def parts_left(comparison: Comparison, missing: Collection[Job]) -> list[Comparison]:
    """What of a comparison its missing runs are made by.

    Args:
        comparison: The runs.
        missing: Those of them that have to be made.

    Returns:
        Comparisons that have these runs and no others, methods and arms that lack the same seeds
        together.
    """
    lacking: dict[tuple[str, Arm, str], list[int]] = {}
    for job in comparison.jobs:
        if job in missing:
            lacking.setdefault((job.learner, job.arm, job.method), []).append(job.seed)
    methods: dict[tuple[str, Arm, tuple[int, ...]], list[str]] = {}
    for (learner, arm, method), seeds in lacking.items():
        methods.setdefault((learner, arm, tuple(seeds)), []).append(method)
    arms: dict[tuple[str, tuple[str, ...], tuple[int, ...]], list[Arm]] = {}
    for (learner, arm, of_arm), names in methods.items():
        arms.setdefault((learner, tuple(names), of_arm), []).append(arm)
    return [
        replace(comparison, learners=(learner,), methods=names, seeds=of_arms, arms=tuple(alike))
        for (learner, names, of_arms), alike in arms.items()
    ]


def seconds_of(job: Job, comparison: Comparison) -> tuple[float, float] | None:
    """Time that a run and its evaluation took, alone in its process.

    Args:
        job: A run that is done.
        comparison: What it is a run of.

    Returns:
        Wall-clock time of the training and of the evaluation [s]; None for a run without
        evaluations during training.
    """
    found = read_table(job.path / files.EVALUATIONS)
    if not len(found):
        return None
    # The policy is written at the end of the training, the rows at that of the evaluation, which
    # begins at once. A second one begins some time later: it takes no longer than a training.
    trained, tested = (
        path.stat().st_mtime
        for path in (job.path / files.POLICY, job.results(comparison.evaluation) / files.EPISODES)
    )
    training = float(found["trained_for"].iloc[-1] + found["seconds"].sum())
    return training, min(tested - trained, training)


def hours_left(comparisons: Sequence[Comparison], *, jobs: int) -> float | None:
    """Time until all runs of some comparisons are done.

    Args:
        comparisons: What is wanted; a run that two of them want is made once.
        jobs: Runs at a time.

    Returns:
        Hours, by the median run of each comparison, or of all if it has none yet; None before
        the first.
    """
    typical = [_medians(_seconds(comparison)) for comparison in comparisons]
    of_all = _medians([each for each in typical if each is not None])
    if of_all is None:
        return None
    left = 0.0
    training: set[Path] = set()
    testing: set[tuple[Path, Evaluation]] = set()
    for comparison, seconds in zip(comparisons, typical, strict=True):
        to_train, to_test = seconds or of_all
        done = {job.path for job in jobs_done(comparison)}
        for job in comparison.jobs:
            test = job.path, comparison.evaluation
            if job.path in done or test in testing:
                continue
            testing.add(test)
            left += to_test
            if job.path not in training and not job.is_trained():
                training.add(job.path)
                left += to_train
    return left / jobs / 3600


def counts(comparisons: Sequence[Comparison]) -> tuple[int, int]:
    """Runs that are trained and tested wherever they shall be, and all that are wanted."""
    done: dict[Path, bool] = {}
    for comparison in comparisons:
        whole = {job.path for job in jobs_done(comparison)}
        for job in comparison.jobs:
            done[job.path] = done.get(job.path, True) and job.path in whole
    return sum(done.values()), len(done)


def _seconds(comparison: Comparison) -> list[tuple[float, float]]:
    found = (seconds_of(job, comparison) for job in jobs_done(comparison))
    return [seconds for seconds in found if seconds is not None]


def _medians(times: Sequence[tuple[float, float]]) -> tuple[float, float] | None:
    """Of training and evaluation."""
    if not times:
        return None
    training, testing = zip(*times, strict=True)
    return median(training), median(testing)
