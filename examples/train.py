"""Train a navigation policy with any method and learner.

    python examples/train.py                              MPFA-PER, 16 robots, new worlds
    python examples/train.py method=per seed=3            another method, another seed
    python examples/train.py actions=5000                 a short run, of all robots together
    python examples/train.py regime=paper                 Table 1, one robot, worlds A, B, C, D
    python examples/train.py regime=paper curriculum=A    only world A
    python examples/train.py -m seed=0,1,2 method=mpfa_per,per    a sweep, in hydra.sweep.dir
    python examples/train.py settings=runs/tune/best.yaml    a file of settings; these words win
    python examples/train.py plugin=mine.py method=mine    a method of your own
    python examples/train.py resume=runs/rooms-mpfa_per-ddpg-0    resume a run that was stopped

``training/settings/`` has every setting; ``--help`` prints them with their values. Ctrl-C,
SIGTERM, SIGHUP, SIGUSR1 and SIGUSR2 let the iteration end and save. Exit status: 0; 1 after an
error, with the last iteration saved; 2 if a setting is wrong; 128 plus the number of the signal
that stopped it.
"""

from __future__ import annotations

import sys
from pathlib import Path

import training.extra  # noqa: F401

# isort: split
from training import files
from training.finished import after_the_end, is_finished
from training.plugins import with_plugin


def main() -> None:
    """Check the command line, then train."""
    arguments = sys.argv[1:]
    if {"-h", "--help"} & set(arguments):
        from training.settings.command_line import help_text

        try:
            print(help_text(__doc__ or "", arguments))
        except ValueError as error:
            print(f"train.py: {error}", file=sys.stderr)
            raise SystemExit(2) from None
        return
    only, _, folder = "".join(arguments).partition("resume=")
    is_drawn = (Path(folder) / files.CURVE).exists()
    if len(arguments) == 1 and not only and is_drawn and is_finished(Path(folder)):
        print(after_the_end(Path(folder)))
        raise SystemExit(0)
    # The parts of a run take seconds to import: what is misspelt is answered before.
    from training.settings.command_line import parse_overrides, read_settings
    from training.settings.train import register

    try:
        settings, _ = with_plugin(arguments)
        register()
        parse_overrides(settings)
        if not any(word.startswith("resume=") for word in settings):
            next(read_settings(settings), None)
    except ValueError as error:
        print(f"train.py: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    from training.run.script import train

    train(arguments)


if __name__ == "__main__":
    files.run_script(main)
