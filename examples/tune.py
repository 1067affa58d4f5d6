"""Search settings of ``train.py`` by greedy success in validation worlds.

    python examples/tune.py learner=td3 method=per --trials 40    ranges of examples/tune.yaml
    python examples/tune.py --ranges mine.yaml --folder runs/mine    your own
    python examples/tune.py learner=sac --seeds 3000 3001 3002    each trial by the mean of three
    python examples/tune.py --objective last --jobs 8             by the last policies, eight a time
    python examples/tune.py --ray HEAD:6379                       on all machines of a Ray cluster

Settings are of all trials, before the options or after ``--``. Optuna's TPE suggests what is tried
next from what was found; a trial that is worse than half of those at their end were after as many
evaluations is pruned. It can be stopped or killed at any moment and continued by the same command,
or with more ``--trials``: finished trials stay, and trials in progress resume from their last
checkpoint.

A trial of the default 30,000 actions takes some one and a half minutes of a core, one that is
pruned at its third evaluation a third of that. The files in the folder:

    best.yaml    the best settings so far: train.py settings=runs/tune/best.yaml learner=td3
    search.png   the trials, and how much each setting mattered (from ten trials on)
    trials.csv   a row for each trial
    study.db     Optuna's study "tune", for optuna-dashboard or scripts of your own
    trial-NNNN/  the runs of a trial

The best value of many is too good to be true: compare its settings with the old ones by other seeds
in test worlds, ``compare.py --arm default: --arm tuned:settings=runs/tune/best.yaml``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import training.extra  # noqa: F401

# isort: split
from training import files
from training.options import add_options, add_plugin, check_least
from training.plugins import with_plugin

RANGES = Path(__file__).with_suffix(".yaml")
FIRST_SEED = 3000
"""First seed of the runs of a search; no study and no default of another script uses it."""


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("settings", nargs="*", help="of all trials, as train.py takes them")
    parser.add_argument(
        "--ranges", type=Path, default=RANGES, help="what is searched (default: tune.yaml)"
    )
    parser.add_argument("--trials", type=int, default=40, help="in all (default: 40)")
    parser.add_argument(
        "--seeds",
        nargs="+",
        type=int,
        default=[FIRST_SEED],
        help=f"a trial is a run with each of them (default: {FIRST_SEED})",
    )
    parser.add_argument(
        "--objective",
        choices=["area", "last"],
        default="area",
        help="area under the curve of success, or success of the last policy (default: area)",
    )
    add_plugin(parser)
    parser.add_argument("--sampler-seed", type=int, default=0, help="of what is suggested")
    add_options(parser, folder="runs/tune", what="trials")
    options = parser.parse_args(arguments)
    check_least(parser, options, trials=1, jobs=1, sampler_seed=0)
    for seed in options.seeds:
        if options.seeds.count(seed) > 1:
            parser.error(f"--seeds has {seed} twice")
    if find_spec("optuna") is None:
        parser.error("it needs Optuna: install the extra 'tune', see Install in the README")
    # Imported here, and below, as they take seconds: what is misspelt is answered before.
    from training.settings.command_line import parse_overrides
    from training.settings.train import register

    try:
        options.settings, _ = with_plugin(options.settings, options.plugin)
        register()
        parse_overrides(options.settings)
        # Imports Optuna, an extra of its own.
        from training.comparison.ranges import read_ranges

        files.check_folder(options.folder)
        options.searched = read_ranges(options.ranges, options.settings)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Search, and print how to train with the best settings.

    The exit status is 1 if trials failed one after another to the end, 2 if the folder holds
    another search, 128 and the number of the signal that stopped the search.
    """
    options = parse(arguments)
    from training.comparison.search import BEST, Plan, run_search

    if options.ray is not None:
        # The other machines know it by this name.
        options.folder = options.folder.resolve()
    settings, seeds = tuple(options.settings), tuple(options.seeds)
    plan = Plan(settings, options.searched, seeds, options.objective, options.sampler_seed)
    try:
        status = run_search(
            plan, options.folder, trials=options.trials, most=options.jobs, ray=options.ray
        )
    except (ValueError, files.FolderInUse) as error:
        print(f"tune.py: {error}", file=sys.stderr)
        return 2
    best = options.folder / BEST
    if best.exists():
        print(f"{best}:\n{best.read_text(encoding='utf-8')}", end="")
    return status


if __name__ == "__main__":
    files.run_script(main)
