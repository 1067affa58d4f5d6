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


def read_json(path: Path) -> Mapping[str, Any]:
    """Read a JSON file of a run; empty if there is none."""
    try:
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    except ValueError as error:
        raise ValueError(f"{path} is damaged: remove it, and the run is made again") from error
