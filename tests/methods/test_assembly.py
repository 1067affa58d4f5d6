"""make_replay: every method from its name, and a sentence for every mistake."""

from dataclasses import asdict, fields, replace

import pytest
import torch

from tests.methods.replays import make_transitions, seeded
from torchrl_mpfa import SignalMemmapStorage, SignalReplayBuffer, SignalTensorStorage, make_actor
from torchrl_mpfa.methods import ALIASES, METHODS, Method, loss_options, make_replay
from torchrl_mpfa.methods.assembly import unused_settings
from torchrl_mpfa.methods.catalogue import RANGES, check_ranges
from torchrl_mpfa.methods.hvper import RELATIVE_ERROR, RELATIVE_VALUE

NAN = float("nan")


def more(name):
    """Further arguments of KLPER and ReF-ER."""
    asks = name in {"klper", "ref_er"}
    return {"policy": make_actor(6, 2, width=8), "sigma": 0.2} if asks else {}


def make_whole_transitions(count):
    made = make_transitions(count)
    made["observation"] = torch.randn(count, 6, generator=seeded(1))
    made["action"] = torch.rand(count, 2, generator=seeded(2)) * 2 - 1
    made["behavior_mean"] = made["action"] + 0.1
    made["behavior_sigma"] = torch.full((count, 1), 0.3)
    made["episode"] = torch.arange(count).unsqueeze(1) // 10
    made["next", "done"] = made["episode"] < made["episode"].roll(-1)
    return made


@pytest.mark.parametrize("name", METHODS)
def test_every_method_gives_batches_and_takes_what_its_loss_writes(name):
    replay = make_replay(name, capacity=64, batch_size=8, generator=seeded(0), **more(name))
    assert isinstance(replay.buffer, SignalReplayBuffer)
    assert replay.method.name == ALIASES.get(name, name) or name in ALIASES
    assert replay.signals == tuple(loss_options(name)["signals"])
    replay.buffer.extend(make_whole_transitions(64))
    for _ in range(3):
        draws = 0
        for draw in replay.select(replay.buffer):
            count = len(draw.batch)
            assert draw.new_step == (draws == 0)
            draws += 1
            for signal in replay.signals if draw.gives_signals else ():
                draw.batch["signals", signal] = torch.rand(count)
            if replay.signals and draw.gives_signals:
                replay.buffer.update_tensordict_priority(draw.batch)
        assert draws == {"la3p": 3, "uniform_halves": 2}.get(name, 1)
        assert count == (4 if name in {"la3p", "uniform_halves"} else 8)


def test_a_setting_reaches_its_part():
    replay = make_replay("mpfa_per", capacity=50, batch_size=5, alpha=0.3, boost_factor=2.0)
    assert replay.buffer.sampler.alpha == 0.3
    assert replay.buffer.sampler.adjustments[0].boost == 2.0
    assert asdict(METHODS["mpfa_per"]) == asdict(Method())


@pytest.mark.parametrize("name", METHODS)
def test_every_number_and_switch_of_a_method_is_within_its_range(name):
    check_ranges(METHODS[name])
    assert not list(unused_settings(METHODS[name]))
    for field in fields(Method):
        if isinstance(getattr(METHODS[name], field.name), int | float):
            assert field.name in {*RANGES, "positive_above"}


def test_a_method_of_ones_own_may_carry_what_it_does_not_use():
    mine = replace(METHODS["mpfa_plus"], name="mine")
    assert make_replay(mine, capacity=10, boost_factor=2.0).method.boost_bound == "none"


def test_a_method_of_ones_own_is_made_alike():
    mine = Method("mine", ["td_error", "novelty"], fusion="scaled", boost=False, decay=False)
    assert make_replay(mine, capacity=10).signals == ("novelty", "td_error")


@pytest.mark.parametrize("kind", [SignalTensorStorage, SignalMemmapStorage])
def test_a_storage_may_be_given_and_its_size_is_that_of_the_sampler(kind):
    storage = kind(77, signals=["td_error"])
    replay = make_replay("per", storage=storage)
    assert replay.buffer.sampler.max_size == 77
    assert replay.method.capacity == 77


def test_the_exponent_of_pal_is_that_of_the_method():
    assert loss_options("pal")["pal_alpha"] == 0.4
    assert loss_options("la3p")["pal_alpha"] == 0.4
    assert loss_options(Method("mine", loss_function="pal", alpha=0.7))["pal_alpha"] == 0.7


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "mpfa-per"}, "unknown method 'mpfa-per': did you mean 'mpfa_per'?"),
        ({"boost_facter": 2}, "unknown setting 'boost_facter': did you mean 'boost_factor'?"),
        ({"selection": "ranked"}, "unknown selection 'ranked': did you mean 'rank'?"),
        ({"fusion": "x"}, r"unknown fusion 'x': must be one of \['entropy', 'fixed'"),
        ({"decay_position": "row"}, "unknown decay_position 'row'"),
        ({"capacity": 0}, "capacity must be an integer from 1 to 2147483647, got 0"),
        ({"batch_size": 2.5}, "batch_size must be an integer from 1 to 2147483647, got 2.5"),
        ({"alpha": -1.0}, "alpha must be finite and not negative, got -1.0"),
        ({"method": "lap", "priority_floor": -1}, "priority_floor must be finite and not negative"),
        ({"method": "lap", "priority_floor": NAN}, "priority_floor must be finite .* got nan"),
        ({"method": "hvper", "replay_penalty": -1}, "replay_penalty must be finite and not neg"),
        ({"method": "reaper", "reliability": -1}, "reliability must be finite and not negative"),
        ({"boost": "x"}, "boost must be true or false, got 'x'"),
        ({"beta_end": NAN}, r"beta_end must be in \[0, 1\], got nan"),
        ({"curiosity_scale": -1}, "curiosity_scale must be positive and finite, got -1"),
        ({"boost_target": -1}, r"boost_target must be in \[0, 1\), got -1"),
        ({"weight_floor": 1.0}, r"weight_floor must be in \[0, 1\), got 1.0"),
        ({"method": "per", "weight_floor": 0.2}, "weight_floor must be 0.0 with fusion='fixed'"),
        ({"method": "geometric", "recency": -1}, "recency must be finite and not negative, got -1"),
        ({"method": "ref_er", "far_cutoff": 0}, "far_cutoff must be positive and finite, got 0"),
        (
            {"method": "per", "boost_factor": 10.0},
            "boost_factor must be 3.0 with boost=False, which cannot use it, got 10.0",
        ),
        ({"method": "mpfa_plus", "boost_bound": "cap"}, "boost_bound must be 'none' with boost="),
        ({"method": "ddpg", "boost": True}, "boost must be False with selection='uniform'"),
        ({"method": "per", "decay_position": "rank"}, "decay_position must be 'batch' with decay"),
        (
            {"method": "uniform", "combination": "product"},
            "combination must be 'sum' with selection='uniform', which cannot .* got 'product'",
        ),
        ({"method": "cer", "reliability": 0.2}, "reliability must be 0.0 with selection='newest'"),
        ({"method": "per", "floor_quantile": 0.5}, "floor_quantile .* with priority_floor=0.0,"),
        (
            {"method": "rank_per", "combination": "mixture"},
            "combination 'mixture' needs selection='prioritized', got 'rank'",
        ),
        ({"method": "klper"}, "method 'klper' needs policy and sigma"),
        ({"method": "klper", "sigma": 0.1}, "method 'klper' needs policy:"),
        ({"method": 3}, "method must be a name or a Method, got 3"),
        ({"beta": "x"}, "beta must be a number, got 'x'"),
        ({"alpha": None}, "alpha must be a number, got None"),
        (
            {"storage": SignalTensorStorage(10, signals=["td_error", "reward"])},
            "signals .*action_gradient.* are not in the storage",
        ),
    ],
)
def test_a_mistake_is_rejected_in_one_sentence(arguments, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make_replay(**arguments)


def test_annealing_raises_beta_to_its_end_and_moves_the_fusion():
    replay = make_replay("hvper", capacity=100, batch_size=4)
    sampler, betas, weights = replay.buffer.sampler, [], []
    names = [RELATIVE_VALUE.name, RELATIVE_ERROR.name]
    for fraction in (0.0, 0.5, 1.0):
        replay.anneal(fraction)
        betas.append(sampler.beta)
        weights.append(sampler.fusion.weights(names, None, None).tolist())
    method = replay.method
    assert betas == [method.beta, (method.beta + method.beta_end) / 2, method.beta_end]
    assert weights == [[0.0, 1.0], [0.25, 0.75], [0.5, 0.5]]


@pytest.mark.parametrize(("floor", "shares"), [(0.0, [5, 0, 0]), (0.2, [5, 1, 1])])
def test_with_a_floor_all_signals_count_before_the_first_goal(floor, shares):
    replay = make_replay("mpfa_per", capacity=100, weight_floor=floor)
    rows = make_transitions(8)
    rows["next", "reward"] = -torch.arange(1.0, 9.0).unsqueeze(-1)
    replay.buffer.extend(rows)
    sampler = replay.buffer.sampler
    table = replay.buffer.storage.signal_table
    weights = sampler.fusion.weights(replay.method.signals, table, torch.arange(8))
    assert weights.tolist() == pytest.approx([share / sum(shares) for share in shares])


def test_annealing_by_a_fraction_that_is_none_changes_nothing():
    replay = make_replay("per", capacity=100)
    for fraction in (-0.1, 1.1, float("nan")):
        with pytest.raises(ValueError, match=r"fraction must be in \[0, 1\], got"):
            replay.anneal(fraction)
    assert replay.buffer.sampler.beta == replay.method.beta


@pytest.mark.parametrize("name", ["uniform", "pal", "cer"])
def test_annealing_without_priorities_does_nothing(name):
    make_replay(name, capacity=100).anneal(1.0)


def test_batches_follow_the_generator():
    def sampled():
        replay = make_replay("per", capacity=100, batch_size=20, generator=seeded(5))
        replay.buffer.extend(make_transitions(100))
        return replay.buffer.sample()["index"]

    assert sampled().equal(sampled())
