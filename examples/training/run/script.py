"""The work of ``train.py``: one run, a sweep, or a run that resumes."""

from __future__ import annotations

import json
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig
from torch._dynamo.exc import BackendCompilerFailed

from torchrl_mpfa.saving import write_text_atomically
from training import files
from training.doors import drive_through_doors, is_asked
from training.finished import after_the_end, is_finished, nothing_learned
from training.inherited import forget_single_run
from training.plugins import with_plugin
from training.records import EpisodeRecord, as_table
from training.run.assembly import method_of, prepare_compiler
from training.run.checkpoints import read_checkpoint
from training.run.hooks import Hook
from training.run.loop import TrainingRun
from training.settings.checks import check_settings
from training.settings.command_line import composed, parse_overrides, with_lines
from training.settings.resuming import changed, check_lawful, check_single
from training.settings.train import TrainSettings, as_settings, plain_settings, register
from training.worlds import understood

WRONG = 2
"""Exit status of a command line that cannot be."""
_SWEEP = ("-m", "--multirun")


class Rejected(Exception):
    """A run that does not begin, with the reason in one sentence."""


def train(arguments: list[str], hooks: Sequence[Hook] = ()) -> None:
    """Check the command line, which Hydra reads as well, then train.

    Args:
        arguments: The settings, ``sys.argv[1:]``.
        hooks: Hooks to call during the run; each run of a sweep calls the same hooks.

    Raises:
        SystemExit: Unless the exit status is 0; ``train.py`` lists the others.
    """
    try:
        arguments, _ = with_plugin(arguments)
        register()
        overrides = parse_overrides(arguments)
        folders = [o.value() for o in overrides if o.key_or_group == "resume"]
        resumes = bool(folders) and folders[-1] is not None
        runs = [] if resumes else list(composed(arguments))
        named = any(override.key_or_group == "run_dir" for override in overrides)
        if named and any(option in arguments for option in _SWEEP) and not resumes:
            raise ValueError(
                "run_dir is for one run: those of a sweep have their settings as names, in the "
                "folder hydra.sweep.dir=FOLDER"
            )
        for settings in runs:
            files.check_folder(Path(settings.run_dir))
        for text in arguments:
            if text.startswith(("hydra.sweep.dir=", "hydra.sweep.subdir=", "hydra.run.dir=")):
                files.check_name(Path(text.partition("=")[2]))
    except (ValueError, OSError) as error:
        _exit(error)
    if resumes:
        _end_with(lambda: resume(Path(str(folders[-1])), overrides, hooks))
    elif len(runs) == 1 and not any(text.startswith(("-", "hydra")) for text in arguments):
        _end_with(lambda: start(runs[0], Path(runs[0].run_dir), hooks))
    else:
        # Sweeps, and Hydra's other modes; Hydra composes the settings once more, and raises what
        # it would report by a traceback of its own.
        os.environ.setdefault("HYDRA_FULL_ERROR", "1")
        if len(runs) > 1:
            forget_single_run()

        def run(config: DictConfig) -> None:
            folder = Path(HydraConfig.get().runtime.output_dir)
            _end_with(lambda: start(as_settings(config), folder, hooks))

        sys.argv[1:] = with_lines(arguments)
        try:
            with files.naming("the folder of the sweep"):
                hydra.main(version_base="1.3", config_path=None, config_name="train")(run)()
        except HydraException as error:
            _exit(error)


def _end_with(run: Callable[[], int]) -> None:
    """Run; exit with the status of the run."""
    try:
        status = run()
    except Rejected as error:
        _exit(error)
    if status:
        raise SystemExit(status)


def _exit(error: Exception) -> NoReturn:
    """Print an error in one line, and exit."""
    print(f"train.py: {' '.join(str(error).split())}", file=sys.stderr)
    raise SystemExit(WRONG if files.no_room(error) is None else 1) from error


def start(settings: TrainSettings, folder: Path, hooks: Sequence[Hook] = ()) -> int:
    """Begin a run.

    Args:
        settings: The settings, checked.
        folder: Folder of the run.
        hooks: Hooks to call during the run.

    Returns:
        Exit status: 0, or 128 and the number of the signal that stopped the run.

    Raises:
        SystemExit: With 1 if the machine lacks what the run needs, after one line of what that is.
        Rejected: If the folder holds a run and ``overwrite`` is false, if another run is using
            it, or if the parts reject a setting.
    """
    with ExitStack() as held:
        with _rejecting():
            held.enter_context(files.lock(folder))
            if (folder / files.CHECKPOINT).exists() and not settings.overwrite:
                raise ValueError(
                    f"{folder} holds a run: continue it with resume={folder}, or start again with "
                    "overwrite=true"
                )
            prepare_process(settings)
            settings = replace(settings, run_dir=str(folder))
            training = TrainingRun(settings, folder, hooks=hooks)
            # Only now: a setting that the parts reject leaves the old run in its place.
            files.set_aside(folder)
            write_settings(settings, folder / files.SETTINGS)
        worlds = [*(stage.world for stage in settings.curriculum.stages), settings.evaluation.world]
        print(understood(settings.environment.robot, worlds))
        if method_of(settings) != settings.method:
            print(f"learner={settings.learner.name} has no action gradient: it is left out")
        return _train(training)


def resume(folder: Path, overrides: list[Override], hooks: Sequence[Hook] = ()) -> int:
    """Resume a run at its checkpoint."""
    with ExitStack() as held:
        with _rejecting():
            check_single(overrides)
            if not folder.is_dir():
                raise FileNotFoundError(f"resume: there is no folder {folder}")
            for name in (each.key_or_group for each in overrides):
                if name in ("run_dir", "overwrite"):
                    raise ValueError(f"resume: {name} has no effect, a run resumes in its folder")
            held.enter_context(files.lock(folder))
            state = read_checkpoint(folder)
            _check_plugin(state, overrides)
            settings = changed(state["settings"], overrides)
            check_settings(settings)
            before = as_settings(state["settings"])
            check_lawful(before, settings, folder)
            is_drawn = (folder / files.CURVE).exists() or not state["records"]
            longer = settings.curriculum.stages != before.curriculum.stages
            if is_finished(folder) and is_drawn and not longer:
                print(after_the_end(folder))
                return 0
            prepare_process(settings)
            training = TrainingRun(settings, folder, state, hooks)
            # A finished run that gets more episodes is unfinished, and its curve is too short.
            for name in (files.STATUS, files.CURVE):
                (folder / name).unlink(missing_ok=True)
            write_settings(settings, folder / files.SETTINGS)
        return _train(training)


def _check_plugin(state: dict[str, Any], overrides: list[Override]) -> None:
    """Raise if a run that had a plugin gets none; warn if the plugin is another one."""
    had, before = state["settings"].get("plugin"), state.get("plugin")
    given = [each.value() for each in overrides if each.key_or_group == "plugin"]
    if had is not None and not given:
        raise ValueError(f"resume: the run was made with a plugin: add plugin={had}")
    if given and files.digest_of(given[-1]) != before:
        print(
            "warning: the plugin has changed since the run was saved: if its rewards, methods or "
            "sensors differ, what is in the buffer is of the former ones",
            file=sys.stderr,
        )


def prepare_process(settings: TrainSettings) -> None:
    """Set threads, arithmetic and logging."""
    torch.set_num_threads(settings.threads)
    # Weights that no gradient reaches decay until they are denormal numbers; after some five
    # thousand updates a CPU takes twice as long for each because of them.
    torch.set_flush_denormal(True)
    prepare_compiler()
    # TorchRL announces each storage in the middle of the progress bar.
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    # The compiler of programs for a CPU warns that a CUDA toolkit is there and no GPU.
    logging.getLogger("torch.utils.cpp_extension").setLevel(logging.ERROR)


def _train(training: TrainingRun) -> int:
    """Train to the end, plot the run, print how it ended; return the exit status."""
    folder, failure = training.folder, None
    try:
        # Logs may find only at their end that they cannot be written.
        with files.naming(folder), closing(training):
            finished = training.train()
            _draw_charts(training)
    except KeyboardInterrupt:
        # An earlier signal asked to save first; this one ends the run.
        training.stop.signal = training.stop.signal or signal.SIGINT
        finished = False
    except Exception as error:
        if outside_cause(error) is None:
            raise
        finished, failure = False, error
    if training.tracker.upload is not None:
        print(f"wandb: upload with: {training.tracker.upload}")
    if finished:
        made = (
            f"   curve: {folder / files.CURVE}"
            if training.records
            else " (no episode has ended, and so there is no curve)"
        )
        print(f"policy: {folder / files.POLICY}{made}")
        if training.updates and is_asked(training.settings):
            print(drive_through_doors(folder))
        if not training.updates:
            print(nothing_learned(training.actions, training.settings.method.rows))
        return 0
    saved = (folder / files.CHECKPOINT).exists()
    plugin = training.settings.plugin
    words = f"resume={folder}" + (f" plugin={plugin}" if plugin else "")
    how = f"continue with: train.py {words}" if saved else "nothing of it was saved, begin again"
    if failure is not None:
        print(f"train.py: {outside_cause(failure)}", file=sys.stderr)
    print(f"stopped after {training.actions} actions; {how}")
    if failure is not None:
        raise SystemExit(1) from failure
    return training.stop.exit_status


def _draw_charts(training: TrainingRun) -> None:
    """Draw the chart of the priorities and the learning curve of a run."""
    # Charts are made of tables and by matplotlib, which take a second to import.
    from mpfa_envs.render.charts import plot_histograms
    from training.figures import plot_learning_curve

    if histograms := training.log.history.histograms():
        plot_histograms(histograms, training.folder / files.HISTOGRAMS)
    # Last: a finished run without its curve draws both when it resumes.
    if training.records:
        table = as_table(training.records, EpisodeRecord)
        plot_learning_curve(table, training.folder / files.CURVE)


def write_settings(settings: TrainSettings, path: Path) -> None:
    """Write the settings of a run as JSON."""
    values = plain_settings(settings)
    if settings.plugin is not None:
        values["plugin_sha256"] = files.digest_of(settings.plugin)
    write_text_atomically(json.dumps(values, indent=2) + "\n", path)


@contextmanager
def _rejecting() -> Iterator[None]:
    """Turn errors before the first step into :class:`Rejected`."""
    try:
        yield
    except (ValueError, OSError, files.FolderInUse) as error:
        full = files.full_disk(error)
        said = " ".join(str(error).split()) if full is None else f"{full}, {files.AGAIN}"
        raise Rejected(said) from error
    except (MemoryError, RuntimeError) as error:
        cause = outside_cause(error)
        if cause is None:
            raise
        raise Rejected(cause) from error


def outside_cause(error: Exception) -> str | None:
    """Return what the machine lacks, in one sentence; None for other errors."""
    said = str(error).partition("\n")[0].strip()
    if isinstance(error, BackendCompilerFailed):
        return (
            f"the update could not be compiled, {said}: install a C++ compiler and the headers of "
            "Python, or begin again with learner.compile=false"
        )
    if isinstance(error, MemoryError | torch.OutOfMemoryError) or "allocate memory" in said:
        how_much = said.rpartition("memory: ")[2]
        return (
            "not enough memory for method.capacity, learner.width, method.batch_size and robots "
            f"as they are ({how_much})"
        )
    if (full := files.full_disk(error)) is not None:
        return full
    return None
