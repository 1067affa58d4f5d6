"""The intrinsic curiosity module, and RAdam: the two parts of DDPG with RAdam and curiosity."""

import copy

import pytest
import torch
from tensordict import TensorDict

from benchmarks.paper.methods.ddpg_radam import Curiosity, intrinsic_reward
from tests.mpfa.learning import make_learner
from tests.mpfa.transitions import seeded
from torchrl_mpfa.learners.adam import FlatAdam


def make_batch(count=64, *, seed=0, shift=0.0):
    generator = seeded(seed)
    observation = torch.randn(count, 6, generator=generator) + shift
    action = torch.rand(count, 2, generator=generator) * 2 - 1
    after = observation.clone()
    after[:, :2] += action
    return TensorDict(
        {
            "observation": observation,
            "action": action,
            "next": {
                "observation": after,
                "reward": torch.randn(count, 1, generator=generator),
            },
        },
        [count],
    )


def test_bonus_is_its_formula():
    foreseen, found = torch.randn(2, 5, 3, generator=seeded(1)).unbind(0)
    expected = [
        0.5 * 0.01 * sum((a - b) ** 2 for a, b in zip(x, y, strict=True))
        for x, y in zip(foreseen.tolist(), found.tolist(), strict=True)
    ]
    assert intrinsic_reward(foreseen, found, scale=0.01).tolist() == pytest.approx(expected)


def test_losses_are_their_formulas():
    curiosity, batch = Curiosity(6, 2, forward_share=0.2), make_batch(4)
    encode = curiosity.encoder
    inverse = forward = 0.0
    with torch.no_grad():
        for row in batch:
            phi, then = encode(row["observation"]), encode(row["next", "observation"])
            told = curiosity.inverse_model(torch.cat((phi, then)))
            foreseen = curiosity.forward_model(torch.cat((phi, row["action"])))
            inverse += float((told - row["action"]).square().sum()) / 4
            forward += 0.5 * float((foreseen - then).square().sum()) / 4
    log = curiosity(batch)
    assert log["inverse_loss"].item() == pytest.approx(inverse, rel=1e-4)
    assert log["forward_loss"].item() == pytest.approx(forward, rel=1e-4)


def test_model_whose_loss_has_no_share_does_not_move():
    curiosity = Curiosity(6, 2, forward_share=1.0)
    models = curiosity.inverse_model, curiosity.forward_model
    before = [[p.clone() for p in model.parameters()] for model in models]
    curiosity(make_batch())
    moved = [
        any(not p.equal(q) for p, q in zip(model.parameters(), old, strict=True))
        for model, old in zip(models, before, strict=True)
    ]
    assert moved == [False, True]


def test_bonus_is_computed_at_each_sampling_and_the_reward_is_kept():
    curiosity, stored = Curiosity(6, 2), make_batch()
    first, second = stored.clone(), stored.clone()
    curiosity(first)
    for seed in range(20):
        curiosity(make_batch(seed=seed))
    curiosity(second)
    assert not torch.equal(first["next", "intrinsic_reward"], second["next", "intrinsic_reward"])
    for batch in (first, second):
        assert torch.equal(batch["next", "extrinsic_reward"], stored["next", "reward"])
        torch.testing.assert_close(
            batch["next", "reward"],
            stored["next", "reward"] + batch["next", "intrinsic_reward"],
        )


def test_models_with_a_loaded_state_learn_like_those_that_saved_it():
    first, second = Curiosity(6, 2), Curiosity(6, 2)
    for seed in range(3):
        first(make_batch(seed=seed))
    second.restore(copy.deepcopy(first.checkpoint()))
    logs = [each(make_batch(seed=9)) for each in (first, second)]
    assert all(logs[0][key].equal(logs[1][key]) for key in logs[0])
    assert all(
        torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True)
    )


@pytest.mark.parametrize(
    "key", ["observation", "action", ("next", "observation"), ("next", "reward")], ids=str
)
def test_batch_with_nan_is_rejected_and_changes_nothing(key):
    curiosity, batch = Curiosity(6, 2), make_batch()
    curiosity(make_batch(seed=1))
    before = copy.deepcopy(curiosity.checkpoint())
    batch[key][5, 0] = torch.nan
    spoiled = batch.clone()
    with pytest.raises(ValueError, match=r"batch must be finite, got nan in .*, row 5"):
        curiosity(batch)
    assert set(batch.keys(True)) == set(spoiled.keys(True))
    after = curiosity.checkpoint()
    assert all(torch.equal(after["models"][k], before["models"][k]) for k in before["models"])
    assert str(after["optimizer"]) == str(before["optimizer"])


def test_radam_is_that_of_pytorch():
    assert isinstance(make_learner(optimizer="radam").optimizer, torch.optim.RAdam)
    assert isinstance(make_learner(optimizer="adam").optimizer, FlatAdam)
