"""The README: its diff of a script runs, its commands and links exist."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from torchrl_mpfa.methods import METHODS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
[DIFF] = re.findall(r"```diff\n(.*?)```", README, re.DOTALL)
SETUP = """
import torch
from torchrl.collectors import Collector
from torchrl.objectives import DDPGLoss, SoftUpdate
from torchrl_mpfa import make_actor, make_critic
from mpfa_envs import make_navigation_env

torch.manual_seed(0)
env = make_navigation_env("A", num_envs=8, physics="kinematic", seed=0)
actor, critic = make_actor(24, 2, width=16), make_critic(24, 2, width=16)
collector = Collector(
    env, actor, frames_per_batch=80, total_frames=240, auto_register_policy_transforms=True
)
loss = DDPGLoss(actor, critic, delay_actor=True, loss_function="l2")
loss.make_value_estimator(gamma=0.95)
targets = SoftUpdate(loss, tau=0.005)
optimizer = torch.optim.Adam(loss.parameters(), lr=3e-4)
"""


def side(sign: str) -> str:
    """Return one side of the diff, with what a script has before it and after it."""
    lines = [line[1:] for line in DIFF.splitlines() if not line or line[0] in (" ", sign)]
    return "\n".join([SETUP, *lines, "collector.shutdown()"])


def run(script: str) -> dict[str, Any]:
    """Run a script; return its names."""
    names: dict[str, Any] = {}
    # Not the project's code: TorchRL's users write such scripts.
    exec(compile(script, "script.py", "exec"), names)
    return names


@pytest.mark.filterwarnings("ignore:.*:DeprecationWarning")
def test_script_of_torchrl_alone_runs_before_the_diff() -> None:
    names = run(side("-"))
    assert "mpfa" not in names
    assert len(names["buffer"]) == 240


@pytest.mark.filterwarnings("ignore:.*:DeprecationWarning")
def test_script_after_the_diff_fuses_the_signals_of_its_batches() -> None:
    names = run(side("+"))
    stats = names["buffer"].stats()
    assert {"share/reward", "share/td_error", "share/action_gradient"} <= stats.keys()
    assert len(names["buffer"]) == 240
    assert "TensorDictReplayBuffer" not in names
    # Priorities of sampled transitions follow their signals: they differ from those of fresh ones.
    index = names["batch"]["index"]
    priorities = names["buffer"].sampler.priorities(index)
    assert len(set(priorities.tolist())) > 10


def test_diff_changes_nothing_but_sampler_buffer_and_signals() -> None:
    removed = [line for line in DIFF.splitlines() if line.startswith("-")]
    added = [line for line in DIFF.splitlines() if line.startswith("+")]
    assert len(removed) <= 3 and len(added) <= 5
    assert "collector" not in "".join(removed) and "loss(batch)" not in "".join(removed)


def test_its_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"(?:^    |`)make ([a-z-]+)", README, re.MULTILINE))
    assert {"demo", "test"} <= targets
    for target in targets:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_no_line_is_longer_than_a_page_is_wide() -> None:
    assert [line for line in README.splitlines() if len(line) > 120] == []


def test_page_has_110_lines_at_most() -> None:
    assert len(README.splitlines()) <= 110


def test_number_of_methods_is_that_of_the_catalogue() -> None:
    for page in ("README.md", "docs/peers.md", ".ci/site_cards.md"):
        assert f"{len(METHODS)} named methods" in (ROOT / page).read_text(encoding="utf-8")
