"""Settings: Hydra composes them, typed, and each mistake is one sentence."""

from __future__ import annotations

import runpy
from copy import deepcopy
from dataclasses import asdict, fields, is_dataclass
from functools import reduce
from itertools import zip_longest
from pathlib import Path

import pytest
from hydra.core.global_hydra import GlobalHydra

from torchrl_mpfa.checks import rules_of
from training.settings.checks import OF_A_METHOD, check_settings
from training.settings.command_line import composed, parse_overrides, with_lines
from training.settings.resuming import changed
from training.settings.rules import settings_by_name
from training.settings.train import (
    GROUPS,
    Stage,
    TrackingSettings,
    TrainSettings,
    curriculum_name,
)


@pytest.fixture(autouse=True)
def hydra_at_rest() -> None:
    GlobalHydra.instance().clear()


def one(*arguments: str) -> TrainSettings:
    (settings,) = composed(arguments)
    return settings


@pytest.mark.parametrize(
    "folder",
    ["/runs/ünï", "/runs/日本/Ωμ", "/runs/a b é", "/runs/🤖#1", "'/runs/ü'", "/runs/plain"],
)
def test_a_folder_has_letters_of_any_alphabet(folder) -> None:
    assert one(f"run_dir={folder}").run_dir == folder.strip("'")


def test_words_of_any_alphabet_in_lists_and_sweeps_are_kept_apart() -> None:
    words = parse_overrides(["curriculum.stages=[{world:ünï.yaml,actions:9},{world:B,actions:9}]"])
    assert [stage["world"] for stage in words[0].value()] == ["ünï.yaml", "B"]
    found = [settings.run_dir for settings in composed(["run_dir=/ü,/b,/ï"])]
    assert found == ["/ü", "/b", "/ï"]
    assert with_lines(["run_dir=/ü", "-m", "seed=1"]) == ["run_dir='/ü'", "-m", "seed=1"]


def test_the_defaults_are_table_1_of_the_paper() -> None:
    settings = one("regime=paper")
    assert (settings.robots, settings.updates) == (1, 1)
    assert (settings.learner.actor_lr, settings.learner.critic_lr) == (1e-4, 1e-4)
    assert (settings.learner.gamma, settings.learner.tau) == (0.99, 0.01)
    assert (settings.method.capacity, settings.method.batch_size) == (100_000, 256)


# The first choices of all groups together, the second ones, and so on.
@pytest.mark.parametrize("choices", [*zip_longest(*GROUPS.values())], ids=str)
def test_every_choice_of_every_group_passes_the_checks(choices: tuple[str | None, ...]) -> None:
    words = [f"{group}={each}" for group, each in zip(GROUPS, choices, strict=True) if each]
    # Goals in hindsight are for rewards without a progress.
    one(*words, *(["environment.progress=none"] if "method=her" in words else []))


@pytest.mark.parametrize(
    ("words", "places"),
    [
        ((), ("offline", False, False)),
        (("tracking=offline",), ("offline", False, False)),
        (("tracking=[wandb,csv]",), ("offline", True, False)),
        (("tracking=[csv,tensorboard,online]",), ("online", True, True)),
        (("tracking=off", "tracking.mode=online"), ("online", False, False)),
    ],
)
def test_tracking_is_one_place_or_several(
    words: tuple[str, ...], places: tuple[str, bool, bool]
) -> None:
    found = one("regime=paper", *words).tracking
    assert (found.mode, found.csv, found.tensorboard) == places
    if words:
        # A run that goes on is logged where it is told, not where it was.
        before = asdict(TrainSettings(tracking=TrackingSettings(tensorboard=True)))
        assert changed(before, parse_overrides(words)).tracking == found


def test_a_file_of_settings_gives_way_to_the_command_line(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    stages = "[{world: A, actions: 500}]"
    file.write_text(
        f"learner: td3\nlearner.tau: 1e-3\nlearner.lr_power: null\nlearner.layer_norm: false\n"
        f"method.signals: [reward, td_error]\ncurriculum.stages: {stages}\n"
    )
    found = one(f"settings={file}", "learner.lr_power=2", "learner.tau=0.25")
    words = ("learner=td3", "learner.tau=0.25", "learner.lr_power=2", "learner.layer_norm=false")
    words += ("method.signals=[reward,td_error]", f"curriculum.stages={stages}")
    assert found == one(*words)
    assert found.learner.tau == 0.25 and found.curriculum.stages == [Stage("A", actions=500)]
    # A choice of a group leaves the other lines as they are, as on a command line.
    assert one(f"settings={file}", "learner=sac").learner.tau == 1e-3
    assert with_lines(["-m", f"settings={file}", "seed=0,1", "learner=sac"])[:2] == [
        *("-m", "learner.tau=0.001")
    ]


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ([], "rooms"),
        (["curriculum=A"], "A"),
        (["regime=paper"], "paper"),
        (["curriculum.stages=[{world: mixed, actions: 500}]"], "mixed500"),
        (["curriculum=paper", "curriculum.stages=[{world: A, episodes: 2}]"], "A2"),
        (["curriculum.stages=[{world: A, episodes: 3},{world: B, episodes: 4}]"], "A3+B4"),
        (["curriculum.name=mine", "curriculum.stages=[{world: D, episodes: 5}]"], "mine"),
    ],
)
def test_a_run_is_called_after_the_stages_that_it_has(arguments: list[str], name: str) -> None:
    settings = one(*arguments)
    assert settings.curriculum.name == name
    assert settings.run_dir == f"runs/{name}-mpfa_per-ddpg-0"


@pytest.mark.parametrize(
    ("arguments", "world"),
    [
        ([], "mazes:validation"),
        (
            ["curriculum.stages=[{world: A, actions: 5},{world: crowd, actions: 5}]"],
            "crowd:validation",
        ),
        (["curriculum=A"], "A"),
        (["curriculum=A", "evaluation.world=bars:validation"], "bars:validation"),
        (["regime=paper"], "validation"),
    ],
)
def test_policies_are_chosen_in_worlds_such_as_those_of_the_training(
    arguments: list[str], world: str
) -> None:
    evaluation = one(*arguments).evaluation
    assert evaluation.world == world
    assert (evaluation.choose, evaluation.every) == (
        (False, 0) if world == "validation" else (True, 5_000)
    )


def test_long_curricula_that_differ_have_short_names_that_differ() -> None:
    first, second = (
        curriculum_name([Stage(f"rooms-{n}", episodes=last) for n in range(20)]) for last in (1, 2)
    )
    assert first != second
    assert len(first) < 60


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
    with pytest.raises(ValueError, match=message):
        parse_overrides([argument])


def test_known_settings_sweeps_and_flags_pass_the_check() -> None:
    arguments = ["-m", "seed=0,1,2", "method=mpfa_per,per", "hydra.verbose=true", "--cfg", "job"]
    found = [(s.seed, s.method.name) for s in composed(arguments)]
    assert found == [(seed, method) for seed in (0, 1, 2) for method in ("mpfa_per", "per")]


@pytest.fixture(scope="module")
def usual() -> TrainSettings:
    GlobalHydra.instance().clear()
    return one()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("learner.saturation_penalty=nan", "learner.saturation_penalty must be .*got nan"),
        ("learner.width=0", "learner.width must be from 1 to 65536, got 0"),
        ("device=warp", "device must be one that PyTorch knows, got 'warp'"),
        ("tracking.mode=of", "tracking.mode must be one of offline, online, off, got 'of'"),
        ("evaluation.world=X", "evaluation.world: world must be .*got 'X'"),
        ("evaluation.world=rooms:7-9", "evaluation.world: world must be rooms:validation or .*7-9"),
        ("curriculum.name=a/b", "curriculum.name must be letters"),
        ("robots=0", "robots must be from 1 to 4096, as a robot takes .* of memory, got 0"),
        (
            "evaluation.choose=true evaluation.every=9 evaluation.world=mixed:test",
            "evaluation.choose must be false with evaluation.world=mixed:test, .* nothing may be",
        ),
        ("updates=0", "updates must be at least 1, got 0"),
        ("evaluation.every=0", "evaluation.choose needs evaluations: set evaluation.every"),
        ("method.capacity=100", "method.capacity must hold a batch of 256, got 100"),
        ("method.population=bufer", "method.population must be one of buffer, batch, got 'bufer'"),
        ("environment.robot=burgr", "environment.robot must be .*'burgr' .did you mean 'burger'"),
        ("exploration.random_steps=-1", "exploration.random_steps must be at least 0"),
        # Learners without continuous actions, or without an actor.
        *(
            (f"learner={learner} method={method}", f"method={method} is not for learner={learner}")
            for learner in ("dqn", "q_learning")
            for method in ("la3p", "ref_er", "uper")
        ),
        *(
            (f"learner=q_learning method={method}", "method.loss_function must be l2 with .*ning")
            for method in ("lap", "pal")
        ),
        ("learner=dqn method=pal", "loss_function must be l2 or smooth_l1 with learner=dqn, got p"),
        (
            "learner=q_learning learner.reward_scale=0.1",
            "learner.reward_scale must be 1 with q_learning, .* got 0.1",
        ),
        (
            "learner=dqn method=per method.signals=action_gradient",
            "method.signals must hold reward or td_error with learner=dqn",
        ),
        ("learner=dqn learner.compile=true", "learner.compile must be false with dqn, got True"),
        ("method=her", "environment.progress must be 'none' with goals"),
    ],
)
def test_setting_with_a_bad_value_is_rejected_by_name_in_one_sentence(
    usual: TrainSettings, arguments: str, message: str
) -> None:
    # Set by hand, as Hydra takes most of the time.
    settings = deepcopy(usual)
    for name, text in (each.split("=") for each in arguments.split(" ")):
        *groups, last = name.split(".")
        group = reduce(getattr, groups, settings)
        kind = type(getattr(group, last))
        if name in ("learner", "method"):
            chosen = GROUPS[name][text]
            setattr(settings, name, chosen() if name == "learner" else deepcopy(chosen))
        elif text == "true" or kind is list:
            setattr(group, last, True if text == "true" else [text])
        else:
            setattr(group, last, kind(text))
    with pytest.raises(ValueError, match=message) as caught:
        check_settings(settings)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("learner.gamma=2", r"learner.gamma must be in \[0, 1\], got 2.0"),
        ("seed=abc", "seed: Value 'abc'"),
        ("curriculum.stages=[]", "curriculum.stages must name at least one world"),
        (
            "curriculum.stages=[{world: A, episodes: -3}]",
            r"curriculum.stages\[0\] must have episodes or actions, at least 1, got episodes=-3",
        ),
        (
            "curriculum.stages=[{world: A, episodes: 2},{world: A, actions: 2}]",
            r"curriculum.stages\[1\] must count what the others count, episodes or actions",
        ),
        ("method=ddpg method.reliability=0.2", "this method has no method.reliability, but name, "),
        ("method=reaper method.hindsight=2", "method.hindsight must be 0 with reaper, .* got 2"),
        (
            "regime=paper environment.filter_cost=1",
            "environment.filter_cost must be null where environment.filter is 0, got 1",
        ),
        ("method.name=mine", "unknown method 'mine'"),
        (
            "curriculum=A environment.clearance=4.9",
            r"stages\[0\].world \(environment.clearance=4.9\): world 'A' has no start",
        ),
        ("method.positive_above=high", "method.positive_above must be a finite number or 'mean'"),
        ("learner=dqn learner.compile=true", "learner.compile must be false with dqn"),
        ("learner.gamma=[", r"'learner.gamma=\[' is not NAME=VALUE"),
        ("run_dir=a[0]", r"is not NAME=VALUE: mismatched input .*: put a value .* in quotes"),
        ("tracking=wand", "unknown choice 'wand' of 'tracking': did you mean 'wandb'"),
        ("tracking=[off,csv]", r"tracking must be off, or one or several of .*got \[off,csv\]"),
        ("tracking=[csv,csv]", r"tracking must be off, .*, got \[csv,csv\]"),
        ("method=[per,lap]", r"method must be one of .*, got \[per,lap\]"),
    ],
)
def test_what_cannot_be_on_a_command_line_is_one_sentence_with_its_name(
    arguments: str, message: str
) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        list(composed(arguments.split(" ") if "{" not in arguments else [arguments]))
    assert "\n" not in str(caught.value)


OF_PARTS = {
    *("physics", "max_steps", "action_repeat", "detour_chance", "progress", "memory", "plan"),
    *("noise.range_noise", "noise.dropout", "noise.slip", "noise.drift", "latency"),
}
"""Settings of the environment that the parts of the task check."""


def test_every_number_and_every_word_among_the_settings_has_a_rule() -> None:
    looked_up = {"resume", "device", "regime", "evaluation.world"}
    looked_up |= {f"environment.{name}" for name in ("robot", "reward", "sensors")}
    free = {"method.signals", "curriculum.stages"}
    settings = TrainSettings()
    rules = {
        f"{entry.name}.{name}"
        for entry in fields(settings)
        if is_dataclass(group := getattr(settings, entry.name))
        for name in rules_of(type(group))
    }
    rules |= {f"method.{name}" for name in OF_A_METHOD} | set(rules_of(type(settings)))
    rules |= {f"environment.{name}" for name in OF_PARTS}
    named = dict(settings_by_name(settings))
    words = {name for name, value in named.items() if not isinstance(value, bool)}
    assert words - looked_up - free == rules & words
    assert rules <= set(named)


@pytest.mark.parametrize("name", sorted(OF_PARTS))
def test_what_a_part_of_the_task_checks_is_told_by_the_name_of_the_setting(
    usual: TrainSettings, name: str
) -> None:
    settings = deepcopy(usual)
    *groups, last = name.split(".")
    group = reduce(getattr, groups, settings.environment)
    setattr(group, last, "x" if isinstance(getattr(group, last), str) else -1)
    with pytest.raises(ValueError, match=rf"^environment\.{name} must .*, got ('x'|-1)"):
        check_settings(settings)


def test_a_learner_that_changes_a_default_keeps_its_rule(usual: TrainSettings) -> None:
    settings = deepcopy(usual)
    settings.learner = GROUPS["learner"]["td3"](policy_delay=0)
    with pytest.raises(ValueError, match=r"learner.policy_delay must be at least 1, got 0"):
        check_settings(settings)


ROOT = Path(__file__).parents[3]
SCRIPT = runpy.run_path(str(ROOT / ".ci" / "settings_page.py"))
PAGE = (ROOT / "docs" / "reference" / "settings.md").read_text(encoding="utf-8")


def test_the_page_has_every_setting_with_the_defaults_that_hold_in_each_regime() -> None:
    assert SCRIPT["page"]() == PAGE, "run: python .ci/settings_page.py"
    for row in (
        "| `robots` | rooms: `16`<br>paper: `1` |",
        "| `learner.tau` | rooms: `0.005`<br>paper: `0.01` |",
        "| `evaluation.world` | rooms: `mazes:validation`<br>paper: `validation` |",
        "| `method.alpha` | `0.6` |",
    ):
        assert row in PAGE
