"""What is misspelt on a command line is answered with a hint, before PyTorch's libraries load."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
HEAVY = ("torchrl", "wandb", "matplotlib", "pandas")
"""Packages that together take longer to import than all else."""


@pytest.mark.parametrize(
    ("script", "word", "hint"),
    [
        ("train.py", "environment.robt=burger", "did you mean 'environment.robot'?"),
        ("train.py", "curriculum.stages=[{world:A,action:500}]", "did you mean 'actions'?"),
        ("evaluate.py", "td3-room", "there is no policy at td3-room"),
        ("report.py", "runs/nowhere", "there is no runs/nowhere"),
    ],
)
def test_a_typo_is_answered_before_the_parts_of_a_run_are_imported(
    script: str, word: str, hint: str
) -> None:
    path = str(EXAMPLES / script)
    code = (
        f"import runpy, sys, training.extra; sys.modules.update(dict.fromkeys({HEAVY})); "
        f"sys.argv = [{path!r}, {word!r}]; runpy.run_path({path!r}, run_name='__main__')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 2 and hint in done.stderr.splitlines()[-1]


def test_scripts_import_no_torchrl_before_they_read_their_command_lines() -> None:
    code = "import sys, train, evaluate, compare, tune, report; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"torch._C", *HEAVY} & set(done.stdout.split())


@pytest.mark.parametrize("word", ["--help", "metod=per"])
def test_train_answers_help_and_a_misspelt_word_without_pytorch(word: str) -> None:
    code = (
        f"import sys, train; sys.argv = ['train.py', {word!r}]\n"
        "try: train.main()\n"
        "finally: print('PARTS', *sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    said, _, modules = done.stdout.partition("PARTS")
    assert not {"torch._C", *HEAVY} & set(modules.split())
    assert "method.name" in said if word == "--help" else "did you mean 'method'" in done.stderr


@pytest.mark.parametrize(
    "first",
    [
        "import torch.optim as part",
        "import torch; from torch import nn as part",
        *(
            pytest.param(first, marks=pytest.mark.slow)
            for first in (
                "from torch.utils import data as part",
                "import torch.distributions as part",
                "import torch.autograd as part",
                "import torch.cuda as part",
                "import torch._dynamo.exc as part",
            )
        ),
    ],
)
def test_what_is_imported_later_is_the_package_itself_whatever_is_asked_for_first(
    first: str,
) -> None:
    code = (
        f"import sys, training.extra\n{first}\n"
        "import torch, torch.optim, torch.cuda, torch.utils.data, torch.nn.functional\n"
        "assert part is sys.modules[part.__name__] and part.__spec__.loader is not None\n"
        "assert part.__spec__.origin == part.__file__\n"
        "for name in ('optim', 'cuda', 'nn', 'utils', 'distributions', 'autograd'):\n"
        "    assert getattr(torch, name) is sys.modules['torch.' + name]\n"
        "assert torch.cuda.memory and torch.nn.grad and torch.utils._pytree\n"
        "assert type(torch).__name__ == 'module' and torch.ones(2).sum().item() == 2"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_threads_that_ask_at_once_for_what_is_imported_later_all_get_it() -> None:
    code = (
        "import training.extra, torch\n"
        "from concurrent.futures import ThreadPoolExecutor\n"
        "with ThreadPoolExecutor(4) as pool:\n"
        "    found = list(pool.map(lambda _: torch.ones(2).sum().item(), range(4)))\n"
        "assert found == [2.0] * 4"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("first", ["training.extra", "multiprocessing.util"])
def test_what_was_imported_before_the_scripts_parts_comes_to_its_own_end(first: str) -> None:
    code = (
        f"import {first}, atexit, multiprocessing, os, sys\n"
        "from training.files import run_script\n"
        "held = multiprocessing.get_context('spawn').Lock()\n"
        "atexit.register(print, 'ended')\n"
        "run_script(lambda: 3)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    # Of locks that were not given back Python's tracker would warn.
    assert (done.returncode, done.stdout, done.stderr) == (3, "ended\n", "")
