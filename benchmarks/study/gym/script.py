"""Train table F of the study, TD3 on Gymnasium tasks; it continues where it was stopped.

    python -m benchmarks.study gym                             120 runs, two at a time
    python -m benchmarks.study gym --seeds 100 101 --jobs 4    two of each arm, four at a time
    python -m benchmarks.study gym --tasks Pendulum-v1 --methods per uniform    one task
    python -m benchmarks.study gym --keep docs/results/study   copy the rows of what is done

A finished run is left alone; an interrupted one is trained again. Ctrl-C waits for the runs in
progress, a second one stops at once. Reacher-v5 needs MuJoCo:
``pip install 'torchrl-mpfa[mujoco]'``. ``python -m benchmarks.study report`` makes page and figures
of the table along with those of the others. For each run, in TASK-METHOD-SEED/:

    evaluations.csv    total reward of greedy episodes over actions, and the same between 0 and 1
    settings.json      everything that the run depends on
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from multiprocessing import active_children, get_context
from pathlib import Path

from tqdm import tqdm

from benchmarks.study.gym.runs import Run, begin_worker, make, wanted
from benchmarks.study.gym.table import FOLDER, SEEDS, TABLE_F, read_runs
from benchmarks.study.gym.tasks import TASKS
from benchmarks.study.gym.training import METHODS
from benchmarks.study.kept_rows import keep
from benchmarks.study.protocol import ROOT
from training import files
from training.stopping import Stop

_PAUSE = 0.5
"""Between two looks at the runs [s]."""


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line; its ``runs`` are what is asked for."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.study gym",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), help="(default: all)")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), help="(default: all)")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS), help="(100 to 109)")
    folder = ROOT / FOLDER
    parser.add_argument("--folder", type=Path, default=folder, help=f"(default: {folder})")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time (default: 2)")
    parser.add_argument("--actions", type=int, help="actions per run (default: as in the table)")
    parser.add_argument(
        "--keep", type=Path, metavar="FOLDER", help="write the rows there; run nothing"
    )
    options = parser.parse_args(arguments)
    if options.jobs < 1:
        parser.error(f"--jobs must be at least 1, got {options.jobs}")
    for name in ("tasks", "methods", "seeds"):
        given = getattr(options, name)
        for place, each in enumerate(given):
            if each in given[:place]:
                parser.error(f"--{name} has {each} twice")
    regime = {} if options.actions is None else {"actions": options.actions}
    try:
        options.runs = wanted(
            options.tasks, options.methods, options.seeds, options.folder, **regime
        )
    except ValueError as error:
        parser.error(str(error))
    return options


def workers(count: int) -> Executor:
    """Processes that make runs, and end with this one."""
    return ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=begin_worker)


def make_all(waiting: Sequence[Run], *, jobs: int, done: int, stop: Stop) -> list[Run]:
    """Make runs, some at a time, with a progress bar."""
    left, running, failed = list(waiting), dict[Future[None], Run](), list[Run]()
    # All runs take about as long: the estimate is by the mean of them.
    bar = tqdm(total=done + len(left), initial=done, unit="run", smoothing=0)
    with bar, stop.listening(), workers(jobs) as pool:
        try:
            while running or (left and not stop):
                while left and len(running) < jobs and not stop:
                    run = left.pop(0)
                    running[pool.submit(make, run)] = run
                ended, _ = wait(running, timeout=_PAUSE, return_when=FIRST_COMPLETED)
                for each in ended:
                    run, error = running.pop(each), each.exception()
                    if error is not None:
                        failed.append(run)
                        tqdm.write(f"{run.name}: failed, {type(error).__name__}: {error}")
                    bar.set_postfix_str(run.name, refresh=False)
                    bar.update()
        except BaseException:
            for child in active_children():
                child.terminate()
            raise
    return failed


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the runs that are missing, or keep the rows of those that are done.

    Args:
        arguments: The command line.

    Returns:
        Exit status: 1 if a run failed, 2 if one has other settings or the folder is in use, 128
        and the number of the signal that stopped it.
    """
    options = parse(arguments)
    if options.keep:
        rows = read_runs(options.folder)
        for path in keep(rows, options.keep, TABLE_F.name) if len(rows.curves) else []:
            print(f"written: {path}, {path.stat().st_size / 1e6:.2f} MB")
        return 0
    stop = Stop("waiting for the runs that are under way; the same command makes the others")
    try:
        with files.lock(options.folder):
            for run in options.runs:
                if difference := run.difference():
                    raise ValueError(
                        f"{run.path} was made with {difference}: name another --folder"
                    )
            waiting = [run for run in options.runs if not run.is_done()]
            done = len(options.runs) - len(waiting)
            print(f"{len(options.runs)} runs, {done} of them done, in {options.folder}")
            failed = make_all(waiting, jobs=options.jobs, done=done, stop=stop) if waiting else []
    except (ValueError, files.FolderInUse) as error:
        print(f"gym: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return stop.exit_status
    return stop.exit_status if stop else int(bool(failed))
