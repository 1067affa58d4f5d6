"""The reconstructed methods of the paper's table: a plugin, its names, and what each asks for."""

import doctest
from collections.abc import Iterator
from dataclasses import fields, replace
from importlib import import_module
from pathlib import Path

import pytest

import compare
from benchmarks.paper.methods import RECONSTRUCTIONS
from benchmarks.paper.methods.hvper import RELATIVE_ERROR, RELATIVE_VALUE
from benchmarks.paper.runs import PLUGIN_FILE, comparisons
from tests.integration.tiny_runs import OVERRIDES
from tests.mpfa.transitions import make_rows, seeded
from torchrl_mpfa import run_updates
from torchrl_mpfa.checks import rules_of
from torchrl_mpfa.methods import METHODS, loss_options, make_replay
from torchrl_mpfa.methods.catalogue import PLUGIN, RECONSTRUCTED, unknown_method
from training.plugins import load_plugin
from training.run.assembly import make_learner
from training.settings.command_line import composed, known_settings, parse_overrides
from training.settings.learners import LearnerSettings
from training.settings.train import register


@pytest.fixture
def plugged() -> Iterator[None]:
    """The methods by their plugin, of which nothing stays."""
    before = dict(METHODS)
    load_plugin(PLUGIN_FILE)
    # Another test may have loaded it, and taken the names back.
    METHODS.update(RECONSTRUCTIONS)
    known_settings.cache_clear()
    register()
    yield
    METHODS.clear()
    METHODS.update(before)
    known_settings.cache_clear()


def test_the_package_names_the_methods_of_the_plugin_and_has_none_of_them() -> None:
    assert set(RECONSTRUCTED) == set(RECONSTRUCTIONS)
    assert not set(RECONSTRUCTED) & set(METHODS)
    assert Path(__file__).parents[3] / PLUGIN == PLUGIN_FILE and PLUGIN_FILE.exists()


@pytest.mark.parametrize("name", RECONSTRUCTED)
def test_a_name_without_the_plugin_says_which_words_to_add(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = f"method '{name}' comes with a plugin: add --plugin {PLUGIN}"
    assert unknown_method(name).startswith(words)
    with pytest.raises(ValueError, match=words):
        make_replay(name)
    with pytest.raises(ValueError, match=words):
        parse_overrides([f"method={name}"])
    with pytest.raises(SystemExit):
        compare.parse(["--methods", name])
    assert words in capsys.readouterr().err


@pytest.mark.usefixtures("plugged")
def test_with_the_plugin_the_names_are_those_of_a_run() -> None:
    for name in RECONSTRUCTED:
        (settings,) = composed([*OVERRIDES, f"method={name}", "curriculum=A"])
        assert settings.method == replace(METHODS[name], batch_size=8, capacity=200)
    for learner in ("dqn", "q_learning"):
        for name in ("hvper", "averaged_ddpg", "ddpg_radam", "klper"):
            with pytest.raises(ValueError, match=f"method={name} is not for learner={learner}"):
                list(composed([f"learner={learner}", f"method={name}", "curriculum=A"]))


def test_the_runs_of_the_paper_load_the_plugin_by_themselves() -> None:
    planned = comparisons(Path("runs"))
    loads = [f"plugin={PLUGIN_FILE}" in each.settings for each in planned]
    needs = [bool({*each.methods} & {*RECONSTRUCTED}) for each in planned]
    assert loads == needs == [True, False, False, False]


@pytest.mark.parametrize("name", RECONSTRUCTED)
def test_each_learns_with_the_learner_that_it_names(name: str) -> None:
    method = RECONSTRUCTIONS[name]
    known = {*rules_of(type(method)), "name", "signals"}
    assert {field.name for field in fields(method)} <= known
    assert replace(method) == method
    settings = LearnerSettings(width=8)
    learner = make_learner(settings, method, 5, 2)
    assert f"{type(learner).__module__}.{type(learner).__name__}".endswith(
        method.learner.rpartition(".")[2]
    )
    replay = make_replay(
        method,
        capacity=200,
        batch_size=8,
        generator=seeded(0),
        policy=learner.policy,
        sigma=0.2,
    )
    assert replay.signals == tuple(loss_options(method)["signals"])
    replay.buffer.extend(make_rows(200))
    log, batch = run_updates(replay.buffer, learner, replay.select, updates=3)
    assert {"loss_value", "loss_actor", "td_error"} <= log.keys()
    for signal in replay.signals:
        assert batch["signals", signal].shape == batch.batch_size
    learner.end_episode()


@pytest.mark.parametrize("name", ["averaged_ddpg", "ddpg_radam", "hvper", "klper", "mw"])
def test_examples_of_its_parts_run(name: str) -> None:
    module = import_module(f"benchmarks.paper.methods.{name}")
    found = doctest.testmod(module)
    assert found.attempted > 0 and found.failed == 0


def test_annealing_moves_the_weights_of_hvper() -> None:
    replay = make_replay(RECONSTRUCTIONS["hvper"], capacity=100, batch_size=4)
    names, weights = [RELATIVE_VALUE.name, RELATIVE_ERROR.name], []
    for fraction in (0.0, 0.5, 1.0):
        replay.anneal(fraction)
        weights.append(replay.buffer.sampler.fusion.weights(names, None, None).tolist())
    assert weights == [[0.0, 1.0], [0.25, 0.75], [0.5, 0.5]]


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("hvper", {"replay_penalty": -1}, "replay_penalty must be finite and not negative"),
        ("ddpg_radam", {"curiosity": -1}, "curiosity must be positive and finite"),
        ("ddpg_radam", {"optimizer": "sgd"}, "optimizer must be one of radam, adam, got 'sgd'"),
        ("klper", {}, "method 'klper' needs policy and sigma"),
        ("klper", {"sigma": 0.1}, "method 'klper' needs policy:"),
    ],
)
def test_bad_setting_is_rejected_in_one_sentence(name, settings, message) -> None:
    with pytest.raises(ValueError, match=message):
        make_replay(RECONSTRUCTIONS[name], **settings)
