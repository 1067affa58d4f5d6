"""How far studies are: runs that are done, and the time that the others will take."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from statistics import median

from navigation import files
from navigation.records import read_table
from navigation.studies import Job, Study


def jobs_done(study: Study) -> list[Job]:
    """Runs of a study that are trained and evaluated."""
    return [job for job in study.jobs if job.is_evaluated(study.evaluation)]


def free_checkpoints(study: Study) -> None:
    """Remove the checkpoints of runs that are done: thousands of them fill a disk."""
    for job in jobs_done(study):
        (job.path / files.CHECKPOINT).unlink(missing_ok=True)


def seconds_of(job: Job, study: Study) -> float | None:
    """Time that a run and its evaluation took, alone in its process.

    Args:
        job: A run that is done.
        study: What it is a run of.

    Returns:
        Wall-clock time [s]; None for a run without evaluations.
    """
    found = read_table(job.path / files.EVALUATIONS)
    if not len(found):
        return None
    # Written at the end of the training, and at the end of the evaluation that follows at once.
    trained, tested = (
        path.stat().st_mtime
        for path in (job.path / files.POLICY, job.path / study.evaluation.folder / files.EPISODES)
    )
    return float(found["trained_for"].iloc[-1] + found["seconds"].sum() + tested - trained)


def hours_left(studies: Sequence[Study], *, jobs: int) -> float | None:
    """Time until all runs of some studies are done.

    Args:
        studies: What is wanted; a run that two of them want is made once.
        jobs: Runs at a time.

    Returns:
        Hours, by the median run of each study, or of all if it has none yet; None before the first.
    """
    typical = [_median(_seconds(study)) for study in studies]
    of_all = _median(each for each in typical if each is not None)
    if of_all is None:
        return None
    left = 0.0
    counted = set()
    for study, seconds in zip(studies, typical, strict=True):
        done = {job.path for job in jobs_done(study)}
        for job in study.jobs:
            wanted = job.path, study.evaluation.folder
            if job.path not in done and wanted not in counted:
                counted.add(wanted)
                left += of_all if seconds is None else seconds
    return left / jobs / 3600


def counts(studies: Sequence[Study]) -> tuple[int, int]:
    """Runs that are done, and all that are wanted; one that two studies want counts once."""
    wanted = {(job.path, study.evaluation.folder) for study in studies for job in study.jobs}
    done = {(job.path, study.evaluation.folder) for study in studies for job in jobs_done(study)}
    return len(done), len(wanted)


def _seconds(study: Study) -> list[float]:
    found = (seconds_of(job, study) for job in jobs_done(study))
    return [seconds for seconds in found if seconds is not None]


def _median(values: Iterable[float]) -> float | None:
    found = list(values)
    return median(found) if found else None
