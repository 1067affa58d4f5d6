"""Search settings of ``train.py`` with Optuna, by greedy success in validation worlds.

    python examples/tune.py learner=td3 method=per --trials 40    ranges of examples/tune.yaml
    python examples/tune.py --ranges mine.yaml --folder runs/mine    your own
    python examples/tune.py learner=sac --seeds 3000 3001 3002    each trial by the mean of three
    python examples/tune.py --objective last                      by the last policies

Settings are of all trials, before the options or after ``--``. Optuna's TPE suggests what is tried
next; a trial that is worse than the median of others after as many evaluations is pruned. The same
command continues a search that was stopped or killed, or has more ``--trials``. Started in several
terminals it makes so many trials at a time. A trial that was killed is resumed from its last
checkpoint, as soon as it has been silent for a minute.

The files in the folder:

    best.yaml    the best settings so far: train.py settings=runs/tune/best.yaml learner=td3
    trials.csv   a row for each trial
    study.db     Optuna's study "tune": optuna-dashboard sqlite:///runs/tune/study.db
    trial-NNNN/  the runs of a trial

The best value of many is too good to be true: compare its settings with the old ones by other seeds
in test worlds, ``compare.py --arm default: --arm tuned:settings=runs/tune/best.yaml``.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import warnings
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import training.extra  # noqa: F401

# isort: split
from training import files
from training.finished import is_finished
from training.inherited import forget_single_run
from training.options import add_plugin, check_least
from training.plugins import with_plugin

if TYPE_CHECKING:
    import optuna
    import pandas as pd

FIRST_SEED = 3000
"""First seed of the runs of a search; no study and no default of another script uses it."""
STUDY, BEST, TRIALS = "study.db", "best.yaml", "trials.csv"
_TAKEN = ("seed", "run_dir", "overwrite", "resume")
"""Settings that a search gives each of its runs."""
_ALIKE = ("actions", "plugin", "evaluation", "curriculum", "regime", "tracking", "device")
"""Groups that are the same in all trials: how trials are compared, and where they run."""
_WORDS = ("low", "high", "log")
"""Of a range of numbers."""
_SILENT = 60
"""Time after which a trial without a sign of life counts as killed [s]."""
_UNPRUNED_TRIALS, _UNPRUNED_EVALUATIONS = 5, 3
"""The first trials, which are what others are compared with, and the first evaluations of each."""


class Failed(Exception):
    """A run that ended by an error, which it has reported."""


class Stopped(Exception):
    """A search that was asked to stop, with its exit status."""


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line, and read the ranges."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("settings", nargs="*", help="of all trials, as train.py takes them")
    ranges = Path(__file__).with_suffix(".yaml")
    parser.add_argument("--ranges", type=Path, default=ranges, help="(default: tune.yaml)")
    parser.add_argument("--trials", type=int, default=40, help="in all (default: 40)")
    parser.add_argument("--seeds", nargs="+", type=int, default=[FIRST_SEED], help="of each trial")
    parser.add_argument(
        "--objective",
        choices=["area", "last"],
        default="area",
        help="area under the curve of success, or success of the last policy (default: area)",
    )
    add_plugin(parser)
    parser.add_argument(
        "--folder", type=Path, default=Path("runs/tune"), help="(default: %(default)s)"
    )
    options = parser.parse_args(arguments)
    check_least(parser, options, trials=1)
    if len(set(options.seeds)) < len(options.seeds):
        parser.error("--seeds has a seed twice")
    if find_spec("optuna") is None:
        parser.error("it needs Optuna: install the extra 'tune', see Install in the README")
    # Imported here, and below, as they take seconds: what is misspelt is answered before.
    from training.settings.command_line import parse_overrides
    from training.settings.train import register

    try:
        options.settings, _ = with_plugin(options.settings, options.plugin)
        register()
        parse_overrides(options.settings)
        files.check_folder(options.folder)
        options.searched = read_ranges(options.ranges, options.settings)
    except (ValueError, TypeError, OSError) as error:
        parser.error(" ".join(str(error).split()))
    return options


def read_ranges(path: Path, settings: Sequence[str]) -> dict[str, Any]:
    """Read ranges from a file, and check their ends with the other settings."""
    from optuna.trial import FixedTrial

    from training.comparison.arms import check_free, with_defaults
    from training.settings.command_line import composed, parse_overrides, read_names
    from training.settings.rules import named
    from training.worlds import is_of_a_test

    check_free(settings, _TAKEN, by="search")
    fixed, *others = composed(with_defaults(settings))
    if others:
        raise ValueError("a search takes one value for each setting, ranges are in its file")
    evaluation, most = fixed.evaluation, sum(each.actions for each in fixed.curriculum.stages)
    if is_of_a_test(evaluation.world):
        raise ValueError(
            f"evaluation.world must not be of a test, got {evaluation.world}: nothing may be "
            "chosen there"
        )
    if evaluation.every == 0 or 0 < most < evaluation.every:
        raise ValueError(
            f"evaluation.every must be from 1 to the {most or 'many'} actions of a run, got "
            f"{evaluation.every}"
        )
    given = {override.key_or_group for override in parse_overrides(settings)}
    with named(f"{path}: "):
        ranges = read_names(path)
        ends = {}
        for name, each in ranges.items():
            if name in given:
                raise ValueError(f"{name} is given to all trials: leave it out here or there")
            if name in _TAKEN or name.split(".")[0] in _ALIKE:
                raise ValueError(f"{name} cannot be searched: it must be the same in all trials")
            is_range = isinstance(each, dict) and {"low", "high"} <= {*each} <= {*_WORDS}
            if not is_range and not (each and isinstance(each, list)):
                raise ValueError(f"{name} must be [VALUE, ...] or {{low: NUMBER, high: NUMBER}}")
            ends[name] = each if isinstance(each, list) else [each.get("low"), each.get("high")]
        # If the ends of a range are allowed, the numbers between them are.
        for number in range(max(map(len, ends.values()))):
            corner = {name: every[min(number, len(every) - 1)] for name, every in ends.items()}
            list(composed([*settings, *as_lines(corner)]))
            for name, each in ranges.items():
                with named(f"{name}: "):
                    suggest(FixedTrial(corner), name, each)
    return ranges


def suggest(trial: optuna.trial.BaseTrial, name: str, values: Any) -> Any:
    """Let a trial suggest one of some values, or a number: a whole one between whole ends."""
    if isinstance(values, list):
        return trial.suggest_categorical(name, values)
    if all(isinstance(values.get(end), int) for end in ("low", "high")):
        return trial.suggest_int(name, **values)
    return trial.suggest_float(name, **values)


def as_lines(values: dict[str, Any]) -> list[str]:
    """Write settings as on the command line of ``train.py``."""
    from training.settings.command_line import as_text

    return [f"{name}={as_text(value)}" for name, value in values.items()]


def value_of(curves: Sequence[pd.DataFrame], objective: str) -> float:
    """Return the mean over the runs of a trial, by their evaluations so far."""
    from training.records import area_under

    if objective == "last":
        return sum(float(curve["success"].iloc[-1]) for curve in curves) / len(curves)
    return sum(area_under(each["total_steps"], each["success"]) for each in curves) / len(curves)


def try_settings(trial: optuna.Trial, options: argparse.Namespace) -> float:
    """Make the runs of a trial one after another, or resume them; return its value."""
    import optuna

    from training.comparison.arms import with_defaults
    from training.records import EvaluationRecord, as_table, read_table
    from training.run.hooks import Hook
    from training.run.loop import TrainingRun
    from training.run.script import train

    # A trial that was stopped or killed is another one for Optuna, of the same settings.
    first = _again().retried_trial_number(trial.study.trials[trial.number])
    folder = options.folder / f"trial-{trial.number if first is None else first:04}"
    values = {name: suggest(trial, name, each) for name, each in options.searched.items()}
    ended: list[pd.DataFrame] = []

    class Judge(Hook):
        """Reports each evaluation to Optuna, and stops a run that is worse than others."""

        hopeless = False

        def on_evaluation(self, run: TrainingRun, record: EvaluationRecord) -> None:
            curves = [*ended, as_table(run.evaluations, EvaluationRecord)]
            trial.report(value_of(curves, options.objective), sum(map(len, curves)))
            # A run at its end has cost all that it can.
            if not run.schedule.finished and trial.should_prune():
                self.hopeless = True
                run.stop.ask()

    for seed in options.seeds:
        run = folder / f"seed-{seed}"
        words = [*with_defaults(options.settings), *as_lines(values), f"seed={seed}"]
        if (run / files.CHECKPOINT).exists():
            words = [f"resume={run}"]
        else:
            words.append(f"run_dir={run}")
        judge = Judge()
        if not is_finished(run):
            try:
                train(words, hooks=[judge])
            except SystemExit as error:
                if isinstance(error.code, int) and error.code > 128:
                    _again()(trial.study, trial.study.trials[trial.number])
                    raise Stopped(error.code) from None
                raise Failed(f"{run} ended with status {error.code}") from None
        # Most of the size of a run is the state to resume it from.
        (run / files.CHECKPOINT).unlink(missing_ok=True)
        if judge.hopeless:
            raise optuna.TrialPruned
        ended.append(read_table(run / files.EVALUATIONS))
    return value_of(ended, options.objective)


def _again() -> Any:
    """Return what lets Optuna try the settings of a trial again that did not come to its end."""
    import optuna

    return optuna.storages.RetryHeartbeatStaleTrialCallback()


def study_of(options: argparse.Namespace) -> optuna.Study:
    """Make or load the study of a folder; raise if it is of another search."""
    import optuna

    options.folder.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        storage=optuna.storages.RDBStorage(
            f"sqlite:///{options.folder / STUDY}",
            heartbeat_interval=max(_SILENT // 4, 1),
            grace_period=_SILENT,
            heartbeat_stale_trial_callback=_again(),
        ),
        study_name="tune",
        direction="maximize",
        load_if_exists=True,
        pruner=optuna.pruners.MedianPruner(_UNPRUNED_TRIALS, _UNPRUNED_EVALUATIONS),
    )
    asked = {name: getattr(options, name) for name in ("searched", "seeds", "objective")}
    asked["settings"] = sorted(options.settings)
    for name, value in asked.items():
        if (found := study.user_attrs.get(name, value)) != value:
            raise ValueError(
                f"{options.folder} holds a search with other {name}, {found}, asked for is "
                f"{value}: name another --folder"
            )
        study.set_user_attr(name, value)
    return study


def main(arguments: Sequence[str] | None = None) -> int:
    """Search, and print how to train with the best settings.

    The exit status is 1 if a run failed, 2 if the folder holds another search, 128 and the number
    of the signal that stopped the search.
    """
    options = parse(arguments)
    import optuna
    import yaml
    from optuna.trial import TrialState

    from torchrl_mpfa.saving import write_text_atomically

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
    forget_single_run()
    ended = (TrialState.COMPLETE, TrialState.PRUNED)

    def keep(study: optuna.Study, trial: optuna.trial.FrozenTrial) -> None:
        """Write the trials and the best settings, and say how a trial ended."""
        print(
            f"trial {trial.number}: {trial.state.name.lower()}, {options.objective} {trial.value}"
        )
        table = study.trials_dataframe(attrs=("number", "value", "state", "duration", "params"))
        text = table.rename(columns=lambda name: name.removeprefix("params_")).to_csv(index=False)
        write_text_atomically(text, options.folder / TRIALS)
        if study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
            best = study.best_trial
            command = shlex.join([f"settings={options.folder / BEST}", *options.settings])
            head = f"# trial {best.number}: {options.objective} {best.value:.4f} in validation: "
            head += f"python examples/train.py {command}\n"
            settings = yaml.safe_dump(best.params, sort_keys=False)
            write_text_atomically(head + settings, options.folder / BEST)

    try:
        study = study_of(options)
        if len(study.get_trials(deepcopy=False, states=ended)) < options.trials:
            most = optuna.study.MaxTrialsCallback(options.trials, states=ended)
            study.optimize(lambda trial: try_settings(trial, options), callbacks=[keep, most])
    except Stopped as stopped:
        print("stopped: the same command continues", file=sys.stderr)
        return int(stopped.args[0])
    except (Failed, ValueError) as error:
        print(f"tune.py: {error}", file=sys.stderr)
        return 1 if isinstance(error, Failed) else 2
    if (options.folder / BEST).exists():
        print((options.folder / BEST).read_text(encoding="utf-8"), end="")
    return 0


if __name__ == "__main__":
    files.run_script(main)
