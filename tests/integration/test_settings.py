"""Settings: Hydra composes them, typed, and a slip of the pen gets a suggestion."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from hydra import compose, initialize
from hydra.core.global_hydra import GlobalHydra

from overrides import check_overrides
from settings import GROUPS, Stage, register
from train import as_settings


@pytest.fixture(autouse=True)
def hydra_at_work() -> Iterator[None]:
    GlobalHydra.instance().clear()
    register()
    with initialize(version_base="1.3", config_path=None):
        yield


def test_the_defaults_are_table_1_of_the_paper() -> None:
    settings = as_settings(compose("train"))
    assert (settings.learner.actor_lr, settings.learner.critic_lr) == (1e-4, 1e-4)
    assert (settings.learner.gamma, settings.learner.tau) == (0.99, 0.01)
    assert (settings.method.capacity, settings.method.batch_size) == (100_000, 256)


def test_the_paper_curriculum_has_a_thousand_episodes() -> None:
    stages = as_settings(compose("train", ["curriculum=paper"])).curriculum.stages
    assert stages == [Stage("A", 100), Stage("B", 200), Stage("C", 300), Stage("D", 400)]
    assert sum(stage.episodes for stage in stages) == 1000


@pytest.mark.parametrize(("group", "choice"), [(g, c) for g, cs in GROUPS.items() for c in cs])
def test_every_choice_of_every_group_composes(group: str, choice: str) -> None:
    as_settings(compose("train", [f"{group}={choice}"]))


def test_an_override_reaches_the_typed_settings() -> None:
    settings = as_settings(compose("train", ["method=per", "method.alpha=0.7", "seed=5"]))
    assert (settings.method.name, settings.method.alpha, settings.seed) == ("per", 0.7, 5)


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("sede=1", r"unknown setting 'sede': did you mean 'seed'\?"),
        ("learner.widht=64", r"unknown setting 'learner.widht': did you mean 'learner.width'\?"),
        ("alpha=0.5", r"unknown setting 'alpha': did you mean 'method.alpha'\?"),
        ("method=prr", r"unknown choice 'prr' of 'method': did you mean 'per'\?"),
        ("+extra=1", r"unknown setting 'extra'"),
    ],
)
def test_an_unknown_setting_is_an_error_that_suggests_the_nearest(
    argument: str, message: str
) -> None:
    with pytest.raises(SystemExit, match=message):
        check_overrides([argument])


def test_known_settings_sweeps_and_flags_pass_the_check() -> None:
    check_overrides(
        ["-m", "seed=0,1,2", "method=mpfa_per,per", "hydra.verbose=true", "--cfg", "job"]
    )
