"""The end of a run, read without PyTorch, which takes seconds to import."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from training import files


def is_finished(folder: Path) -> bool:
    """Return True if a run is finished and its policy and episodes are there."""
    # A name may be too long to be asked for.
    there = all(os.path.exists(folder / name) for name in (files.POLICY, files.EPISODES))
    return there and bool(read_json(folder / files.STATUS).get("finished"))


def holds_result(folder: Path, result: str, settings: Mapping[str, Any]) -> bool:
    """Return True if a folder has the result of a run with these settings, or else record them.

    Args:
        folder: Of the run.
        result: Name of the file that is written at its end.
        settings: Values that JSON has.

    Raises:
        ValueError: If there is a result of other settings, or a file that is damaged.
    """
    if not (folder / result).exists():
        from torchrl_mpfa.saving import write_text_atomically

        write_text_atomically(json.dumps(settings, indent=1) + "\n", folder / files.SETTINGS)
        return False
    before = read_json(folder / files.SETTINGS)
    if before != settings:
        names = [name for name in {**before, **settings} if before.get(name) != settings.get(name)]
        raise ValueError(f"{folder} has a run with other {', '.join(names)}: name another folder")
    return True


def after_the_end(folder: Path) -> str:
    """Return one sentence on what can be done with a finished run."""
    status = read_json(folder / files.STATUS)
    stages = read_json(folder / files.SETTINGS)["curriculum"]["stages"]
    # Its last stage twice as long, as an example.
    *fixed, last = stages
    if last["actions"]:
        longer = f"actions={sum(each['actions'] for each in stages) + last['actions']}"
    else:
        words = [f"{{world: {each['world']}, episodes: {each['episodes']}}}" for each in fixed]
        words.append(f"{{world: {last['world']}, episodes: {2 * last['episodes']}}}")
        longer = f"'curriculum.stages=[{', '.join(words)}]'"
    return (
        f"{folder} is finished, after {status['done']:,} {status['unit']}s: evaluate it with "
        f"evaluate.py {folder}, or train on with train.py resume={folder} {longer}"
    )


def nothing_learned(actions: int, rows: int | None = None) -> str:
    """Return one sentence on a run that was too short to learn from."""
    needs = "" if rows is None else f", as the first update needs {rows}"
    return (
        f"nothing was learned: no update was made in {actions:,} actions{needs}; give more actions"
    )


def warnings_of(folder: Path) -> list[str]:
    """Return sentences on the run of a policy that is not finished, or has learned nothing."""
    status = read_json(folder / files.STATUS)
    said = []
    if status.get("finished") is False and "total" in status:
        done, total = status["done"], status["total"]
        said.append(f"{folder} is not finished: {done:,} of {total:,} {status['unit']}s")
    if status.get("updates") == 0:
        said.append(nothing_learned(status["steps"]))
    return said


def read_json(path: Path) -> Mapping[str, Any]:
    """Read a JSON file of a run; empty if there is none."""
    try:
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    except ValueError as error:
        raise ValueError(f"{path} is damaged: remove it, and the run is made again") from error
