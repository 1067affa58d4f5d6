"""A run from its start to its end: who may write in its folder, and what its exit status says."""

from __future__ import annotations

import json
import logging
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from pathlib import Path

import torch
from hydra.core.override_parser.types import Override
from torch._dynamo.exc import BackendCompilerFailed

from torchrl_mpfa.files import write_text_atomically
from training import files
from training.finished import after_the_end, is_finished
from training.records import EpisodeRecord, as_table
from training.run.assembly import method_of
from training.run.checkpoints import read_checkpoint
from training.run.compiling import prepare_compiler
from training.run.hooks import Hook
from training.run.loop import TrainingRun
from training.settings.checks import check_settings
from training.settings.resuming import changed, check_lawful, check_single
from training.settings.train import TrainSettings, as_settings


class Refused(Exception):
    """A run that is not begun, and why in one sentence."""


@contextmanager
def refusing() -> Iterator[None]:
    """Turn errors of what comes before the first step into :class:`Refused`."""
    try:
        yield
    except (ValueError, OSError, files.FolderInUse) as error:
        raise Refused(" ".join(str(error).split())) from error
    except (MemoryError, RuntimeError) as error:
        cause = outside_cause(error)
        if cause is None:
            raise
        raise Refused(cause) from error


def outside_cause(error: Exception) -> str | None:
    """What the machine lacks, in one sentence; None if an error is about something else."""
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
    kinds = {kind.__name__ for kind in type(error).__mro__}
    # By name, as Ray is an extra; its RayTaskError is an error in what a worker did.
    if "RayError" in kinds and "RayTaskError" not in kinds:
        return f"the Ray cluster has lost what the run needs: {said}"
    return None


def start(settings: TrainSettings, folder: Path, hooks: Sequence[Hook] = ()) -> int:
    """Train anew.

    Args:
        settings: The settings, checked.
        folder: Of the run.
        hooks: What is called on the way.

    Returns:
        Exit status: 0, or 128 and the number of the signal that stopped the run.

    Raises:
        Refused: If the folder holds a run and ``overwrite`` is false, if another run is using
            it, or if the parts refuse a setting.
    """
    with ExitStack() as held:
        with refusing():
            held.enter_context(files.lock(folder))
            if (folder / files.CHECKPOINT).exists() and not settings.overwrite:
                raise ValueError(
                    f"{folder} holds a run: continue it with resume={folder}, or start anew with "
                    "overwrite=true"
                )
            prepare_process(settings)
            settings = replace(settings, run_dir=str(folder))
            training = TrainingRun(settings, folder, hooks=hooks)
            # Only now: a setting that the parts refuse leaves the old run in its place.
            files.set_aside(folder)
            write_settings(settings, folder / files.SETTINGS)
        if method_of(settings) != settings.method:
            print(f"learner={settings.learner.name} has no action gradient: it is left out")
        return _train(training)


def resume(folder: Path, overrides: list[Override], hooks: Sequence[Hook] = ()) -> int:
    """Go on with a run where its checkpoint was written."""
    with ExitStack() as held:
        with refusing():
            check_single(overrides)
            if not folder.is_dir():
                raise FileNotFoundError(f"resume: there is no folder {folder}")
            for name in (each.key_or_group for each in overrides):
                if name in ("run_dir", "overwrite"):
                    raise ValueError(f"resume: {name} is of no use, a run goes on in its folder")
            held.enter_context(files.lock(folder))
            state = read_checkpoint(folder)
            settings = changed(state["settings"], overrides)
            check_settings(settings)
            before = as_settings(state["settings"])
            check_lawful(before, settings, folder)
            if is_finished(folder) and settings.curriculum.stages == before.curriculum.stages:
                print(after_the_end(folder))
                return 0
            prepare_process(settings)
            training = TrainingRun(settings, folder, state, hooks)
            # A run that was finished is not, once it is asked for more.
            (folder / files.STATUS).unlink(missing_ok=True)
            write_settings(settings, folder / files.SETTINGS)
        return _train(training)


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
    folder, failure = training.folder, None
    try:
        finished = training.train()
    except KeyboardInterrupt:
        # Whoever asked before, this is what ends it.
        training.stop.signal = training.stop.signal or signal.SIGINT
        finished = False
    except Exception as error:
        failure = outside_cause(error)
        if failure is None:
            raise
        finished = False
    finally:
        training.close()
    # Charts are made of tables and by matplotlib, which take a second to import.
    from mpfa_envs.render.charts import plot_histograms
    from training.figures import plot_learning_curve

    curve = folder / files.CURVE
    if training.records:
        plot_learning_curve(as_table(training.records, EpisodeRecord), curve)
    if histograms := training.log.history.histograms():
        plot_histograms(histograms, folder / files.HISTOGRAMS)
    if training.tracker.upload is not None:
        print(f"wandb: upload with: {training.tracker.upload}")
    if finished:
        print(f"policy: {folder / files.POLICY}   curve: {curve}")
        return 0
    saved = (folder / files.CHECKPOINT).exists()
    how = f"continue with: train.py resume={folder}" if saved else "nothing of it was saved"
    if failure is not None:
        print(f"train.py: {failure}", file=sys.stderr)
    print(f"stopped after {training.actions} actions; {how}")
    return training.stop.exit_status if failure is None else 1


def write_settings(settings: TrainSettings, path: Path) -> None:
    """Keep the settings of a run where people and comparisons can read them."""
    values = {k: v for k, v in asdict(settings).items() if k not in ("defaults", "hydra")}
    write_text_atomically(json.dumps(values, indent=2) + "\n", path)
