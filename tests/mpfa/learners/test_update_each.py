"""Updates of a round, made by the program at once: those of one batch after the other."""

import pytest
import torch

from tests.mpfa.compiled import UNTRACED, assert_alike
from tests.mpfa.learning import make_batch, make_learner
from torchrl_mpfa import ActorCritic

pytestmark = pytest.mark.filterwarnings("ignore:steps of the RAdam are not compiled")

SIZE = len(make_batch())


def make_rows(count):
    return torch.cat([make_batch(seed=seed, weighted=True) for seed in range(count)])


@pytest.mark.parametrize(
    ("name", "options"),
    [("ddpg", {"policy_delay": 2}), ("td3", {}), ("sac", {}), ("ddpg", {"optimizer": "radam"})],
    ids=str,
)
def test_updates_of_a_round_are_those_of_one_batch_after_the_other(name, options):
    alone, together = (make_learner(name, compile=UNTRACED, **options) for _ in range(2))
    rows = make_rows(5)
    parts = rows.clone().split(SIZE)
    torch.manual_seed(3)
    for part in parts:
        log = alone.update(part)
    torch.manual_seed(3)
    found = together.update_each(rows, 5)
    assert found.keys() == log.keys()
    assert all(value.equal(log[key]) for key, value in found.items())
    assert_alike(alone, together, rtol=0.0, atol=0.0)
    written = set(parts[0].keys(True, True)) - set(make_rows(1).keys(True, True))
    assert written
    for key in written:
        assert rows[key].equal(torch.cat([part[key] for part in parts]))


def test_round_with_a_batch_that_is_not_finite_ends_before_that_batch():
    alone, together = (make_learner("ddpg", compile=UNTRACED) for _ in range(2))
    rows = make_rows(4)
    for part in rows.clone().split(SIZE)[:2]:
        alone.update(part)
    rows["next", "reward"][2 * SIZE] = torch.nan
    with pytest.raises(ValueError, match=r"batch must be finite, got nan in .*, row 0"):
        together.update_each(rows, len(rows) // SIZE)
    assert_alike(alone, together, rtol=0.0, atol=0.0)


def test_round_without_a_program_changes_nothing():
    learner, untouched = make_learner("ddpg"), make_learner("ddpg")
    assert learner.update_each(make_rows(2), 2) is None
    assert_alike(learner, untouched, rtol=0.0, atol=0.0)


@pytest.mark.parametrize("of_class", [True, False], ids=["class", "instance"])
def test_round_is_left_to_an_update_of_ones_own(of_class):
    class Own(ActorCritic):
        def update(self, sampled):
            return super().update(sampled)

    learner = make_learner("ddpg", compile=UNTRACED)
    if of_class:
        learner.__class__ = Own
    else:
        learner.update = lambda sampled: {}
    assert learner.update_each(make_rows(2), 2) is None
    assert learner.updates == 0
