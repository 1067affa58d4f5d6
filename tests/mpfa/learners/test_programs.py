"""Compiled programs: when one is made, who shares it, and where it is kept."""

import copy
import os
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch._dynamo.utils import counters
from torch._inductor import compile_fx, config
from torch._inductor.runtime.cache_dir_utils import default_cache_dir
from torch.fx.experimental.proxy_tensor import make_fx

from tests.mpfa.compiled import UNTRACED, assert_alike, counting, make_pair, update_both
from tests.mpfa.learning import BOUNDS, make_batch, make_learner, make_networks
from torchrl_mpfa import ActorCritic
from torchrl_mpfa.learners import compiled as program


@pytest.mark.parametrize("name", ["ddpg", pytest.param("td3", marks=pytest.mark.slow)])
def test_traced_program_takes_the_same_steps_and_is_made_once_for_all_rates(name):
    made = []
    options = {"target_average": 2} if name == "ddpg" else {}
    learners = make_pair(name, counting(made), **options)
    for seed in range(12):
        for learner in learners:
            learner.anneal(1.0 - seed / 12)
        update_both(learners, seed)
        update_both(learners, seed + 50, trains="critic", loss_function="pal", new_step=False)
    assert_alike(*learners)
    # One for both networks and one for the critic; TD3 delays its actor.
    assert len(made) == {"ddpg": 2, "td3": 3}[name]


@pytest.mark.parametrize("name", ["ddpg", pytest.param("sac", marks=pytest.mark.slow)])
def test_learners_of_equal_settings_share_programs_and_learn_as_alone(name):
    made, others = [], []
    shared, own = counting(made), counting(others)
    learners = [make_learner(name, seed, compile=shared) for seed in range(2)]
    alone = make_learner(name, 1, compile=own)
    for seed in range(3):
        update_both(learners[:1], seed)
    needed = len(made)
    for seed in range(3):
        update_both([alone, learners[1]], 10 + seed)
        update_both(learners[:1], 20 + seed)
    assert len(made) == len(others) == needed
    assert_alike(learners[1], alone, rtol=0, atol=0)


def test_record_with_examples_of_its_results_is_the_one_that_tests_make_without(monkeypatch):
    made = []
    shared = counting(made)
    first, second = (make_learner(seed=seed, compile=shared) for seed in range(2))
    update_both([first], 0)
    needed = len(made)
    monkeypatch.setattr(program, "make_fx", make_fx)
    update_both([second], 0)
    assert len(made) == needed > 0


@pytest.mark.parametrize(
    "options",
    [
        {"gamma": 0.5},
        {"networks": make_networks(width=17)},
        *(
            pytest.param(options, marks=pytest.mark.slow)
            for options in (
                {"loss_function": "smooth_l1"},
                {"networks": make_networks(layer_norm=False)},
                {"policy_noise": 0.3, "bounds": BOUNDS},
            )
        ),
    ],
    ids=lambda options: "-".join(options),
)
def test_learners_of_other_settings_learn_as_alone(options):
    made = []
    shared = counting(made)
    first = make_learner(compile=shared)
    update_both([first], 0)
    options_again = copy.deepcopy(options)
    second = make_learner(**options, compile=shared)
    alone = make_learner(**options_again, compile=UNTRACED)
    for seed in range(2):
        update_both([alone, second], seed)
    assert_alike(second, alone, rtol=0, atol=0)
    # TD3 delays its actor.
    assert len(made) == (3 if "policy_noise" in options else 2)


def test_programs_are_kept_in_a_folder_that_only_the_user_may_enter(tmp_path, monkeypatch):
    # TorchRL has PyTorch name its own folder in the environment, which is not a user's choice.
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", default_cache_dir())
    make_pair("ddpg")
    folder = Path(os.environ["TORCHINDUCTOR_CACHE_DIR"])
    assert folder.is_relative_to(tmp_path)
    assert folder.stat().st_mode & 0o777 == 0o700
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "anything")
    make_pair("ddpg")
    assert os.environ["TORCHINDUCTOR_CACHE_DIR"] == "anything"


@pytest.mark.parametrize("cache", ["no folder", "a folder of another user"])
def test_programs_without_a_folder_of_the_user_stay_in_one_of_this_process(
    cache, tmp_path, monkeypatch
):
    # The folder that PyTorch has by default is one that others can make.
    if cache == "no folder":
        (tmp_path / "torchrl_mpfa").touch()
    else:
        (tmp_path / "torchrl_mpfa").mkdir(mode=0o700)
        monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", default_cache_dir())
    program._folder_of_this_process.cache_clear()
    with pytest.warns(UserWarning, match="programs are compiled at every start"):
        make_pair("ddpg")
    folder = Path(os.environ["TORCHINDUCTOR_CACHE_DIR"])
    assert folder.stat().st_mode & 0o777 == 0o700
    assert not folder.is_relative_to(tmp_path) and str(folder) != default_cache_dir()
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", default_cache_dir())
    make_pair("ddpg")  # Says so once.
    assert os.environ["TORCHINDUCTOR_CACHE_DIR"] == str(folder)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("gamma", 0.5), ("reward_scale", 3.0), ("loss_function", "smooth_l1")),
        *(("signals", ("value",)), ("importance", "torchrl"), ("tau", 0.5)),
    ],
    ids=str,
)
def test_program_is_made_again_for_an_option_that_is_changed(name, value):
    learners = make_pair("ddpg")
    for seed in range(4):
        if seed == 2:
            for learner in learners:
                setattr(learner, name, value)
        update_both(learners, seed)
    assert_alike(*learners)


def test_slices_of_other_tensors_need_no_program_of_their_own():
    made = []
    plain, traced = make_pair("ddpg", counting(made))
    for step in range(1, 12):
        for learner in (plain, traced):
            batch = make_batch(seed=step)
            wide = batch["observation"].repeat_interleave(step, -1)
            batch["observation"] = wide[:, ::step]
            learner.update(batch)
    assert_alike(plain, traced)
    assert len(made) == 1


def test_inductor_is_asked_for_no_second_half_and_for_the_random_numbers_of_the_losses(monkeypatch):
    asked = []

    def compile(module, inputs, **_):
        cached = inputs[0].fake_mode.shape_env is not None
        asked.append((torch.is_grad_enabled(), config.fallback_random, cached))
        return SimpleNamespace(current_callable=lambda values: module.forward(*values))

    monkeypatch.setattr(program, "_COMPILED", {})
    monkeypatch.setattr(compile_fx, "compile_fx_inner", compile)
    learners = make_pair("td3", True, policy_delay=1)
    for seed in range(3):
        update_both(learners, seed)
    assert asked == [(False, True, True)]
    assert_alike(*learners)


@pytest.mark.parametrize("broken", [False, True])
def test_vector_instructions_are_tried_only_where_a_program_cannot_be_made_with_them(
    monkeypatch, broken
):
    asked = []

    def compile(module, inputs, **_):
        asked.append(config.cpp.vec_isa_ok)
        if broken or config.cpp.vec_isa_ok:
            raise OSError("no such instructions")
        return SimpleNamespace(current_callable=lambda values: module.forward(*values))

    monkeypatch.setattr(program, "_COMPILED", {})
    monkeypatch.setattr(compile_fx, "compile_fx_inner", compile)
    learners = make_pair("ddpg", True)
    if broken:
        with pytest.raises(OSError, match="no such instructions"):
            update_both(learners, 0)
    else:
        update_both(learners, 0)
        assert_alike(*learners)
    assert asked == [True, None]


def test_a_wish_about_vector_instructions_is_kept(monkeypatch):
    asked = []

    def compile(module, inputs, **_):
        asked.append(config.cpp.vec_isa_ok)
        return SimpleNamespace(current_callable=lambda values: module.forward(*values))

    monkeypatch.setattr(compile_fx, "compile_fx_inner", compile)
    for wish, options in ((False, {}), (None, {"options": {"cpp.vec_isa_ok": False}})):
        monkeypatch.setattr(program, "_COMPILED", {})
        with config.patch({"cpp.vec_isa_ok": wish}):
            update_both(make_pair("ddpg", options or True), 0)
    assert asked == [False, False]


@pytest.mark.slow
def test_a_graph_that_was_compiled_is_read_from_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    hits = counters["inductor"]
    for hit in (0, 1):
        monkeypatch.setattr(program, "_COMPILED", {})
        before = hits["fxgraph_cache_hit"]
        update_both(make_pair("ddpg", True), 0)
        assert hits["fxgraph_cache_hit"] - before == hit


# Updates of a round, made by the program at once.

SIZE = len(make_batch())


def make_rows(count):
    return torch.cat([make_batch(seed=seed, weighted=True) for seed in range(count)])


@pytest.mark.filterwarnings("ignore:steps of the RAdam are not compiled")
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
