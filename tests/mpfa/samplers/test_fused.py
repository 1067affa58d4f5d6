"""A signal, a fusion and an adjustment of a user's own, without a change of the package."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from tests.mpfa.transitions import make_buffer, make_transitions, rejected
from torchrl_mpfa import REWARD, TD_ERROR, Adjustment, FixedFusion, Fusion, Signal, SignalSampler
from torchrl_mpfa.samplers.table import SignalTable

NOVELTY = Signal("novelty", key=("curiosity", "novelty"))
SURPRISE = Signal("surprise", key="surprise", known_at="write", priority=torch.square)


class LoudestSignal(Fusion):
    """All weight to the signal whose known values have the highest mean."""

    def weights(self, names, table, index):
        rows = table.rows[index][:, [table.column[name] for name in names]]
        means = rows.nanmean(0).nan_to_num(-1.0)
        return torch.nn.functional.one_hot(means.argmax(), len(names)).float()


class CappedReplays(Adjustment):
    """Transitions that were replayed often enough are set aside."""

    def __init__(self, limit):
        self.limit = limit

    def __call__(self, priority, batch):
        return torch.where(batch.replay_count > self.limit, 1e-6, priority)


def make_own_buffer(**kwargs):
    signals = [TD_ERROR, NOVELTY, REWARD, SURPRISE]
    arguments = {
        "signals": signals,
        "fusion": FixedFusion({"novelty": 0.5, "surprise": 0.25, "td_error": 0.25}),
        "adjustments": [],
        "eps": 0.0,
        **kwargs,
    }
    return make_buffer(8, **arguments)


def make_own_transitions(count):
    data = make_transitions(count)
    data["surprise"] = torch.arange(float(count)).unsqueeze(1)
    return data


def update(buffer, index, td_error, novelty):
    batch = TensorDict(
        {
            "index": torch.tensor(index),
            "signals": {"td_error": torch.tensor(td_error)},
            "curiosity": {"novelty": torch.tensor(novelty).unsqueeze(1)},
        },
        [len(index)],
    )
    buffer.update_tensordict_priority(batch)


def priorities(buffer):
    return buffer.sampler.priorities(torch.arange(len(buffer))).tolist()


@pytest.mark.parametrize(
    ("function", "expected"), [(None, [3.0, 5.25]), (torch.square, [4.0, 20.25])]
)
def test_own_signals_go_from_the_batch_to_the_priority(function, expected):
    novelty = replace(NOVELTY, priority=function)
    buffer = make_own_buffer(signals=[TD_ERROR, novelty, REWARD, SURPRISE])
    buffer.extend(make_own_transitions(8))
    update(buffer, [2, 3], td_error=[4.0, 0.0], novelty=[2.0, 6.0])
    # 4/4 + 2/2 + 2^2/4 and 0 + 6/2 + 3^2/4, or 2^2/2 and 6^2/2
    assert priorities(buffer)[2:4] == pytest.approx(expected)


def test_an_own_fusion_and_an_own_adjustment_do_their_work():
    buffer = make_own_buffer(
        fusion=LoudestSignal(), adjustments=[CappedReplays(0)], entropy_refresh=0
    )
    buffer.extend(make_own_transitions(8))
    update(buffer, [2, 3], td_error=[4.0, 0.5], novelty=[2.0, 60.0])
    update(buffer, [2, 3], td_error=[4.0, 0.5], novelty=[2.0, 60.0])
    assert buffer.sampler.weights["novelty"] == 1.0
    assert priorities(buffer)[2:4] == pytest.approx([2.0, 60.0])
    buffer.storage.signal_table.count_replay(torch.tensor([3]))
    update(buffer, [2, 3], td_error=[4.0, 0.5], novelty=[2.0, 60.0])
    assert priorities(buffer)[2:4] == pytest.approx([2.0, 1e-6])


def test_an_own_signal_that_is_named_reward_is_read_where_it_says():
    own = Signal("reward", key="mine")
    assert SignalSampler(8, 0.6, 0.4, signals=[own], reward_key="r").signals == (own,)


def test_highest_priority_that_was_adjusted_to_below_eps_is_zero_without_it():
    buffer = make_own_buffer(adjustments=[CappedReplays(-1)], eps=0.5)
    buffer.extend(make_own_transitions(8))
    update(buffer, list(range(8)), td_error=[1.0] * 8, novelty=[1.0] * 8)
    assert buffer.sampler.default_priority == 0.0


@pytest.mark.parametrize(
    "weights", [torch.ones(2), torch.ones(4, 1), torch.ones(()), [1.0] * 4, None]
)
def test_an_own_fusion_of_the_wrong_shape_is_rejected(weights):
    class Wrong(Fusion):
        def weights(self, names, table, index):
            return weights

    buffer = make_own_buffer(fusion=Wrong())
    buffer.extend(make_own_transitions(8))
    with rejected(
        buffer, ValueError, r"weights of the fusion must be a tensor of shape \[4\], got "
    ):
        update(buffer, [2], td_error=[4.0], novelty=[2.0])


@pytest.mark.parametrize("adjusted", [None, 1.0, torch.ones(())])
def test_an_own_adjustment_that_gives_no_priority_each_is_rejected(adjusted):
    class Wrong(Adjustment):
        def __call__(self, priority, batch):
            return adjusted

    buffer = make_own_buffer(adjustments=[Wrong()])
    buffer.extend(make_own_transitions(8))
    with rejected(buffer, ValueError, r"priorities of Wrong must be a tensor of shape \[1\], got "):
        update(buffer, [2], td_error=[4.0], novelty=[2.0])


@pytest.mark.parametrize("known_at", ["write", "update"])
@pytest.mark.parametrize("wrong", [torch.Tensor.tolist, torch.mean, lambda value: value[:1]])
def test_a_function_of_a_signal_that_gives_no_priority_each_is_rejected(wrong, known_at):
    table = SignalTable(8, [Signal("x", key="x", known_at=known_at, priority=wrong)])
    with pytest.raises(ValueError, match=r"signal 'x' must be a tensor of shape \[4\], got "):
        if known_at == "write":
            table.read({"x": torch.ones(4)}, 4)
        table.fill_learned(table.blank(4), {"x": torch.ones(4)}, None, [4])


@pytest.mark.parametrize("wrong", [-1.0, torch.nan, torch.inf])
def test_wrong_weights_and_wrong_adjusted_priorities_are_rejected(wrong):
    class WrongWeights(Fusion):
        def weights(self, names, table, index):
            return torch.tensor([wrong, 1.0, 1.0, 1.0])

    class WrongPriority(Adjustment):
        def __call__(self, priority, batch):
            return priority * wrong

    buffer = make_own_buffer(fusion=WrongWeights())
    buffer.extend(make_own_transitions(8))
    with pytest.raises(ValueError, match="weights of the fusion must be finite"):
        update(buffer, [2], td_error=[4.0], novelty=[2.0])
    buffer = make_own_buffer(adjustments=[WrongPriority()])
    buffer.extend(make_own_transitions(8))
    before = priorities(buffer)
    with pytest.raises(ValueError, match="adjusted priorities must be finite and not negative"):
        update(buffer, [2], td_error=[4.0], novelty=[2.0])
    assert priorities(buffer) == before
