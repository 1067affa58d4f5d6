"""Experiments: tables H to L, each with its hypothesis in ``docs/study.md``.

All are of the sparse task with TD3 unless they say otherwise, with the robots' map as it is now:
the runs of table C had another, so that what is compared here is trained here.
"""

from __future__ import annotations

from pathlib import Path

from benchmarks.study.protocol import (
    DENSE,
    SPARSE,
    TEST,
    Table,
    arms_of,
    pairs_of,
    seeds_of,
)
from training.comparison.arms import PLAIN, Arm
from training.comparison.jobs import Comparison, Evaluation

EFFECTIVE = {"weak": 0.8, "medium": 0.5, "strong": 0.2}
"""Effective sample sizes at which kinds of priorities are compared, as shares of the buffer."""
KINDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "per": ("per", ()),
    "mpfa_per": ("mpfa_per", ()),
    "floor": ("mpfa_per", ("method.weight_floor=0.2",)),
    "mixture": (
        "mpfa_plus",
        ("method.signals=[reward,td_error]", "method.combination=mixture"),
    ),
}
"""Kinds of priorities that are compared at equal strength: method and settings."""
ALPHAS = {
    "per": (0.63, 0.96, 1.31),
    "mpfa_per": (0.41, 0.56, 0.73),
    "floor": (0.45, 0.63, 0.83),
    "mixture": (0.48, 0.64, 0.85),
}
"""What gives each kind those strengths: ``python -m benchmarks.values strength``."""
NOTE = "Success is that of the last policy on exact arcs, each kind of worlds counting the same."
DRIVEN = Evaluation(TEST.words, 20, "kinematic")
"""What last policies are asked to do: on exact arcs, ten times as fast as on wheels."""


BY_PRIORITY = (
    "method.signals=[reward,td_error]",
    "method.fusion=scaled",
    "method.loss_function=l2",
    "method.eps=0.05",
    "method.alpha=0.6",
    "method.priority_floor=0",
    "method.max_priority_within_buffer=true",
)
"""LA3P's parts with squared errors, by reward and TD error in equal shares."""
APART = (
    Arm("inverse", BY_PRIORITY),
    Arm("apart", (*BY_PRIORITY, "method.selection=apart")),
)
"""The critic learns from rows of high priority, the actor from others: by the inverse, or any."""
TOGETHER = Arm("together", (*BY_PRIORITY, "method.selection=together"))
"""The actor learns from rows of high priority too: added once the two above had won."""
HINDSIGHT = Arm("hindsight", ("method.hindsight=4",))
"""Goals in hindsight beside the priorities of a method: as many as the method ``her`` has."""
LEARNABLE = Arm("learnable", ("environment.learnable_worlds=true",))
"""Worlds of the kinds in which half of the episodes succeed, in place of all kinds alike."""
IN_MAZES = Evaluation(("mazes:test",), 100, "kinematic")
"""Where the success of table K is measured."""
NOISE = Arm("noise", ("environment.reward_noise=2",))
"""Rewards with a standard deviation of 2 in a third of the states."""


def experiments(root: Path) -> tuple[Table, ...]:
    """The tables of the experiments."""
    return (_hindsight(root), _noise(root), _apart(root), _strength(root), _worlds(root))


def _of(folder: Path, methods: tuple[str, ...], *arms: Arm) -> Comparison:
    return Comparison(folder, methods, SPARSE, seeds_of(20), ("td3",), arms or (PLAIN,), DRIVEN)


def _hindsight(root: Path) -> Table:
    folder, at = root / "experiments", "experiments/td3"
    plain = ("uniform", "per", "mpfa_per")
    fused = tuple(f"{at}/{method}/{HINDSIGHT.name}" for method in plain[1:])
    return Table(
        "L",
        "Hindsight: does learning for goals that were reached do more than priorities?",
        (_of(folder, (*plain, "her")), _of(folder, plain[1:], HINDSIGHT)),
        (*pairs_of(at, "her-uniform", "her-per", "her-mpfa_per"), (fused[0], f"{at}/her")),
        (
            *(
                (with_goals, f"{at}/{method}")
                for with_goals, method in zip(fused, plain[1:], strict=True)
            ),
            (fused[1], f"{at}/her"),
            (fused[1], fused[0]),
            *pairs_of(at, "per-uniform", "mpfa_per-uniform", "mpfa_per-per"),
        ),
        {
            "goals as they were": arms_of(at, *plain),
            "and in hindsight": (f"{at}/her", *fused),
        },
        note=NOTE,
    )


def _noise(root: Path) -> Table:
    folder, at = root / "experiments", "experiments/td3"
    methods = ("uniform", "per", "mpfa_per", "mpfa_plus", "uper")
    return Table(
        "I",
        "Noisy rewards: which priorities do they mislead?",
        (_of(folder, methods, NOISE),),
        pairs_of(at, "uper-per", "mpfa_per-uniform", "per-uniform", suffix=f"/{NOISE.name}"),
        pairs_of(
            at,
            *("uper-uniform", "mpfa_plus-uniform", "mpfa_per-per", "uper-mpfa_per"),
            suffix=f"/{NOISE.name}",
        ),
        {"noisy rewards": arms_of(at, *methods, suffix=f"/{NOISE.name}")},
        note=NOTE,
    )


def _apart(root: Path) -> Table:
    folder, at = root / "experiments", "experiments/td3"
    control, arms = f"{at}/uniform_halves", (*APART, TOGETHER)
    return Table(
        "J",
        "Critic and actor apart: does it pay that each has its own batches?",
        (_of(folder, ("uniform_halves",)), _of(folder, ("la3p",), *arms)),
        tuple((f"{at}/la3p/{arm.name}", control) for arm in APART),
        pairs_of(
            at,
            *("la3p/inverse-la3p/together", "la3p/apart-la3p/together"),
            *("la3p/together-uniform_halves", "la3p/apart-la3p/inverse"),
        ),
        {"Critic and actor apart": (control, *(f"{at}/la3p/{arm.name}" for arm in arms))},
        note=NOTE,
    )


def _strength(root: Path) -> Table:
    folder, at = root / "experiments", "experiments/td3"
    arms = {
        (kind, strength): Arm(f"{kind}_{strength}", (*settings, f"method.alpha={alpha}"))
        for kind, (_, settings) in KINDS.items()
        for strength, alpha in zip(EFFECTIVE, ALPHAS[kind], strict=True)
    }
    labels = {key: f"{at}/{KINDS[key[0]][0]}/{arm.name}" for key, arm in arms.items()}
    return Table(
        "H",
        "Strength or kind: what of a priority matters?",
        tuple(
            _of(folder, (method,), *(arms[kind, strength] for strength in EFFECTIVE))
            for kind, (method, _) in KINDS.items()
        ),
        tuple(
            (labels[kind, strength], labels["per", strength])
            for strength in EFFECTIVE
            for kind in KINDS
            if kind != "per"
        ),
        tuple((labels[kind, "strong"], labels[kind, "weak"]) for kind in KINDS),
        {
            f"effective sample of {share:.0%}": tuple(labels[kind, strength] for kind in KINDS)
            for strength, share in EFFECTIVE.items()
        },
        note=NOTE,
    )


def _worlds(root: Path) -> Table:
    folder, at = root / "experiments/dense", "experiments/dense/td3/mpfa_per"
    plain, chosen = at, f"{at}/{LEARNABLE.name}"
    arms = (PLAIN, LEARNABLE)
    return Table(
        "K",
        "Worlds, not transitions: does it pay to train where half of the episodes succeed?",
        tuple(
            Comparison(folder, ("mpfa_per",), DENSE, seeds_of(10), ("td3",), (arm,), IN_MAZES)
            for arm in arms
        ),
        ((chosen, plain),),
        (),
        {"worlds": (plain, chosen)},
        primary="success",
        kinds=IN_MAZES.words,
        note="Success is that of the last policy on exact arcs, in mazes.",
    )
