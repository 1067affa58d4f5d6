"""Equal strength: the effective sample size, and the alpha that gives it."""

from __future__ import annotations

import pytest
import torch

from benchmarks.study.experiments import ALPHAS, EFFECTIVE
from benchmarks.study.experiments import KINDS as TRAINED
from benchmarks.values import FrozenBuffer
from benchmarks.values.arms import ARMS
from benchmarks.values.strength import (
    KINDS,
    alpha_for,
    chances,
    effective_share,
    equal_alphas,
)
from torchrl_mpfa.samplers.tree import TreeSampler


def test_equal_chances_are_an_effective_sample_of_the_whole_buffer() -> None:
    assert effective_share(torch.full((8,), 1 / 8)) == pytest.approx(1.0)
    assert effective_share(torch.tensor([0.5, 0.5, 0.0, 0.0])) == pytest.approx(0.5)


def test_the_alpha_that_is_found_gives_the_effective_sample_that_was_asked_for() -> None:
    sampler = TreeSampler(50, 0.6, 0.4, eps=0.0)
    sampler.update_priority(torch.arange(50), torch.linspace(0.1, 10.0, 50))
    alphas = [alpha_for(sampler, 50, share) for share in (0.9, 0.5, 0.2)]
    assert alphas == sorted(alphas)
    for alpha, share in zip(alphas, (0.9, 0.5, 0.2), strict=True):
        assert effective_share(chances(sampler, 50, alpha)) == pytest.approx(share, abs=0.01)


def test_the_kinds_of_table_h_are_arms_of_table_g() -> None:
    assert [*KINDS] == [*TRAINED] == [*ALPHAS]
    for kind, (method, settings) in TRAINED.items():
        arm = ARMS[KINDS[kind]].method
        floor = arm.weight_floor if "method.weight_floor=0.2" in settings else 0.0
        assert arm.weight_floor == floor
        assert method in ("mpfa_plus", arm.name.split("/")[0])
        assert len(ALPHAS[kind]) == len(EFFECTIVE)


def test_equal_alphas_rise_from_weak_to_strong(walk: FrozenBuffer) -> None:
    found = equal_alphas([walk], updates=4)
    assert list(found.index) == [*KINDS]
    assert (found.diff(axis=1).iloc[:, 1:] > 0).all(axis=None)
