"""make_replay: every method from its name, and a sentence for every mistake."""

from dataclasses import dataclass, fields, replace

import pytest
import torch

from tests.mpfa.transitions import make_rows, seeded
from torchrl_mpfa import SignalMemmapStorage, SignalReplayBuffer, SignalTensorStorage, make_actor
from torchrl_mpfa.checks import rules_of
from torchrl_mpfa.methods import (
    ALIASES,
    METHODS,
    Method,
    Prioritized,
    Scaled,
    loss_options,
    make_replay,
)

NAN = float("nan")


def test_learner_is_not_asked_for_a_signal_of_one_s_own():
    mine = Scaled("mine", signals=["td_error", "novelty"])
    assert make_replay(mine).signals == ("novelty", "td_error")
    assert loss_options(mine)["signals"] == ["td_error"]


@pytest.mark.parametrize("name", METHODS)
def test_every_method_gives_batches_and_takes_what_its_loss_writes(name):
    replay = make_replay(
        name, capacity=64, batch_size=8, generator=seeded(0), policy=make_actor(6, 2, width=8)
    )
    assert isinstance(replay.buffer, SignalReplayBuffer)
    assert replay.method.name == ALIASES.get(name, name) or name in ALIASES
    assert replay.signals == tuple(loss_options(name)["signals"])
    replay.buffer.extend(make_rows(64, observed=6))
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


def test_setting_reaches_its_part():
    replay = make_replay("mpfa_per", capacity=50, batch_size=5, alpha=0.3, boost_factor=2.0)
    assert replay.buffer.sampler.alpha == 0.3
    assert replay.buffer.sampler.adjustments[0].boost == 2.0


@pytest.mark.parametrize("name", METHODS)
def test_every_setting_but_names_and_levels_has_a_rule_or_words(name):
    method = METHODS[name]
    for field in fields(method):
        assert field.name in {*rules_of(type(method)), "name", "signals"}
    assert method.name == name
    assert replace(method) == method


def test_method_of_ones_own_with_known_parts_is_made_like_those_of_the_catalogue():
    mine = Scaled("mine", signals=["td_error", "novelty"])
    replay = make_replay(mine, capacity=10)
    assert replay.signals == ("novelty", "td_error")
    assert replay.method.name == "mine"


def test_method_of_ones_own_class_has_its_settings_and_parts():
    @dataclass
    class Eager(Prioritized):
        name: str = "eager"
        refresh: float = 0.0

        def sampler_options(self):
            return {"entropy_refresh": self.refresh}

    replay = make_replay(Eager(), capacity=10, refresh=0.5)
    assert replay.buffer.sampler.entropy_refresh == 0.5
    with pytest.raises(ValueError, match="unknown setting of eager 'refrsh': did you mean 'refre"):
        make_replay(Eager(), refrsh=1.0)


@pytest.mark.parametrize("kind", [SignalTensorStorage, SignalMemmapStorage])
def test_storage_may_be_given_and_its_size_is_that_of_the_sampler(kind):
    storage = kind(77)
    replay = make_replay("per", storage=storage)
    assert replay.buffer.sampler.max_size == 77
    assert replay.method.capacity == 77


def test_exponent_of_pal_is_that_of_the_method():
    assert loss_options("pal")["pal_alpha"] == 0.4
    assert loss_options("la3p")["pal_alpha"] == 0.4
    assert loss_options(replace(METHODS["pal"], alpha=0.7))["pal_alpha"] == 0.7
    assert loss_options(Method("mine", loss_function="pal"))["pal_alpha"] == 0.4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "mpfa-per"}, "unknown method 'mpfa-per': did you mean 'mpfa_per'?"),
        ({"boost_facter": 2}, "unknown setting of mpfa_per 'boost_facter': did you mean 'boost_f"),
        ({"method": "per", "boost": True}, "unknown setting of per 'boost'"),
        ({"decay_position": "row"}, "decay_position must be one of batch, rank, count, got 'row'"),
        ({"importance": "all"}, "importance must be one of critic, torchrl, none, got 'all'"),
        ({"method": "la3p", "loss_function": "l2"}, "loss_function must be one of smooth_l1, got"),
        ({"capacity": 0}, "capacity must be an integer from 1 to 2147483647, got 0"),
        ({"batch_size": 2.5}, "batch_size must be an integer from 1 to 2147483647, got 2.5"),
        ({"alpha": -1.0}, "alpha must be finite and not negative, got -1.0"),
        ({"method": "lap", "priority_floor": -1}, "priority_floor must be positive and finite"),
        ({"method": "reaper", "reliability": -1}, "reliability must be positive and finite"),
        ({"boost": "x"}, "boost must be true or false, got 'x'"),
        ({"beta_end": NAN}, r"beta_end must be in \[0, 1\], got nan"),
        ({"boost_target": -1}, r"boost_target must be in \[0, 1\), got -1"),
        ({"positive_above": NAN}, "positive_above must be a finite number or 'mean', got nan"),
        ({"weight_floor": 1.0}, r"weight_floor must be in \[0, 1\), got 1.0"),
        ({"method": "geometric", "recency": -1}, "recency must be finite and not negative, got -1"),
        ({"method": "ref_er", "far_cutoff": 0}, "far_cutoff must be positive and finite, got 0"),
        ({"method": "her", "hindsight": -1}, "hindsight must be an integer from 0"),
        ({"method": "reaper", "hindsight": 2}, "hindsight must be 0 with reaper, which .* got 2"),
        ({"method": "ref_er"}, "method 'ref_er' needs policy: it compares actions with its own"),
        ({"method": "klper"}, "method 'klper' comes with a plugin: add --plugin benchmarks/paper"),
        ({"method": 3}, "method must be a name or a Method, got 3"),
        ({"beta": "x"}, "beta must be a number, got 'x'"),
        ({"alpha": None}, "alpha must be a number, got None"),
    ],
)
def test_bad_setting_is_rejected_in_one_sentence(arguments, message, monkeypatch):
    # Another test of this process may have loaded the plugin.
    monkeypatch.delitem(METHODS, "klper", raising=False)
    with pytest.raises((TypeError, ValueError), match=message):
        make_replay(**arguments)


def test_annealing_raises_beta_to_its_end():
    replay = make_replay("per", capacity=100, batch_size=4)
    betas, method = [], replay.method
    for fraction in (0.0, 0.5, 1.0):
        replay.anneal(fraction)
        betas.append(replay.buffer.sampler.beta)
    assert betas == [method.beta, (method.beta + method.beta_end) / 2, method.beta_end]


@pytest.mark.parametrize("name", ["uniform", "pal", "cer"])
def test_annealing_without_priorities_does_nothing(name):
    make_replay(name, capacity=100).anneal(1.0)
