"""The page of the paper's tables and figures: sentences, tables and pictures from kept rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os.path import relpath
from pathlib import Path
from textwrap import fill

import pandas as pd

from benchmarks.paper.answers import answers
from benchmarks.paper.convergence import convergence_table, trained
from benchmarks.paper.convergence import said as faster
from benchmarks.paper.errors import errors_table
from benchmarks.paper.failures import (
    PUBLISHED,
    SPLIT,
    question_left,
    question_power,
    question_table,
)
from benchmarks.paper.figures import plot_figures
from benchmarks.paper.looks import CHANGED, TITLE, looks
from benchmarks.paper.published import MARK, NAMES, TABLE_2, TABLE_4, TESTS, neighbors
from benchmarks.paper.rows import QUESTION, Rows, read_rows
from benchmarks.paper.runs import NEW_SEEDS, comparisons, question
from benchmarks.paper.tables import (
    OTHER_ARMS,
    arms_table,
    comparison_table,
    measures,
    trained_table,
    unseen_table,
)
from torchrl_mpfa.saving import write_text_atomically
from training.comparison.report import table

COMMIT = "a0a3ab5"
"""Commit that trained and tested every run of the kept rows."""
_WIDTH = 120
_MARKED = f"{MARK}: [our reconstruction](../methods/README.md#all-methods) of a method of others."
_FIGURES = {
    3: "TD error and reward per step of DDPG with PER in map A",
    5: "reward per step in map A with MPFA-PER and φ = 2, 3 and 4",
    8: "reward per step with parts of the priority",
    9: "reward per step with the raise of positive transitions",
    10: "reward per step with raise and decay",
    11: "reward per step with all parts together",
    13: "total reward of every 10,000 steps",
}
_QUESTION = """
**Question.** Does MPFA-PER reach more goals than other replay methods, and in fewer training steps,
as the paper's Tables 2 to 4 say?
"""
_WORLDS = f"""
The paper's worlds are not published: [B to D](../worlds.md) are from the public course that it
follows, and the unseen world is our own. So compare methods within a column. Success is that of one
map with 200 pairs of start and goal, and intervals are over seeds alone. Training has [our
additions to DDPG](../paper_map.md#what-the-paper-does-not-say-and-what-we-chose) and sixteen
robots. PER's success is near the ceiling of 100 %, so failures are compared as ratios. A name with
{MARK} is [our reconstruction](../methods/README.md#all-methods) of a method of others. Our numbers
in its rows, and claims with {MARK}, say nothing about the original. Of MPFA-PER, too, gaps were
filled.
"""
_ASKED = """
[The hypothesis, the test and the seeds](study.md#the-papers-question-again) were committed 23
minutes before the first of these runs was kept, with the promise that none would be looked at
before all were there. The split of the failures was added 21 minutes after the first run was kept.
That nobody looked in between is the authors' word. Runs are compared unpaired, as planned.
"""
_FASTER = (
    """
The paper says that training with MPFA-PER converges the fastest, "after 130,000 steps" of Fig. 13,
and that it is stabler. Its text tests neither. Our runs have the paper's 1,000 episodes and end
before so many steps. The table has all 46 seeds, and was made after the figures had been seen: it
is exploratory.
""",
    """
After correction one difference is left: in the last world MPFA-PER reaches more goals than uniform
replay. p are of the permutation test of signs, first as they are, then corrected together by Holm's
method.
""",
)
_PICTURES = """
Mean over runs and its 95 % interval; in brackets the number of runs. [A
table](#does-mpfa-per-learn-faster) compares three of the methods.
"""
_ERRORS = """
In the paper's Fig. 3 the TD error of PER rises after 80 episodes, and the reward per step stays
near 0.5. Ours has ten seeds, made after the other figures were seen. p are of the signs, and not
corrected:
"""
_BY = {"collisions": "a collision", "out of time": "the time limit"}
_TEN = """
Numbers of this table are of the seeds of Tables 2 to 4, ten an arm. [New
seeds](#does-mpfa-per-fail-less-often-than-per) say more of MPFA-PER, PER and uniform replay.
"""
_STEPS = f"""
A step is an action of 0.2 s. Times are those of runs that had the machine to themselves. DDPG +
RAdam{MARK} trains a curiosity model as well, and KLPER{MARK} draws three batches for an update. In
the mean these two took the longest. The speed of the virtual machine was seen to double within ten
minutes. Smaller differences may come from that.
"""
_PHI = """
The factor φ of the raise, as in Fig. 5. These runs train for 100 episodes in world A, which has no
obstacles. So most of their tests in the unseen world end in collisions.
"""
_ROBOTS = """
One robot with one update per action beside sixteen robots with sixteen updates. The study had not
planned this arm.
"""
_LETTER = """
Closer to the paper (`learner=plain`): without our additions to DDPG, with collisions at 0.35 m from
the robot's center as in its code base, without mirrored batches, and with noise of one size. Four
of five tasks have a detour here too, which the paper has not. There are sixteen robots as well.
"""
_READ = (
    """
Each number of ours is the mean over runs with Student's 95 % interval. A run is one seed. It has
1,000 training episodes in the worlds A to D. Then its last policy has 200 tests in an unseen world,
on simulated wheels. A test ends with a collision at contact, and fails by that or by the time
limit, which the paper's tables do not know. The time is that of the tests that reached their goal.
""",
    """
Ratios of failures have an interval by a bootstrap over seeds: 95 % percentiles of 10,000 resamples.
How often it covers a ratio was not tried. Where interval and p disagree, nothing was found. Arms
with at least six seeds in common are compared seed by seed, by the permutation test of signs. Other
arms are compared by the means of all their runs, without a power. *Found with 80 % power* is the
true difference that a t-test of as many seeds finds with that probability. Its level is 5 % divided
by the number of comparisons.
""",
    """
[The study](study.md) has the hypothesis, the planned comparisons and the test. Two things were
changed after the three looks, and before the rows of this page were looked at. The intervals are
Student's in place of a bootstrap's, so that other programs compute the same numbers. Arms closer to
the paper have five seeds in place of ten.
""",
)
_MADE = f"""
Every run was trained and tested at commit {COMMIT}, those of Fig. 3 at 19746a0f, one thread each. A
run takes 4 to 12 minutes. Another kind of processor rounds differently, and makes another run of
the same seed. The commands make runs of the same settings with the code of this version: those of
the tables, which continue where they were stopped, those of Table 3's times, and those of Fig. 3.
The last one writes this page from their rows.
"""
_COMMANDS = """\
    python -m benchmarks.paper run --folder runs/paper
    python -m benchmarks.paper time --folder runs/paper
    python -m benchmarks.paper figure3 --folder runs/paper
    make paper ARGS='--rows runs/paper/rows --output runs/paper'"""
_KEPT = "`make paper` alone writes it from [the rows that are kept](paper):"
_FILES = [
    ["`tests.csv.gz`", "a test of a last policy"],
    ["`curves.csv.gz`", "an evaluation during training"],
    ["`episodes.csv.gz`", "a training episode"],
    ["`question`", "a folder: the same of the runs that test whether MPFA-PER fails less often"],
    ["`figure_3.csv.gz`", "a TD error or a reward of an episode of Fig. 3"],
    ["`times.csv`", "training time of a run that had the machine to itself [min]"],
]


def write_page(rows: Rows, page: Path, pictures: Path) -> list[Path]:
    """Write the page and its figures from the kept rows; return the files."""
    if not rows.runs:
        raise ValueError(f"{rows.folder} has no rows: python -m benchmarks.paper run makes them")
    made = plot_figures(rows, pictures)
    pictured = [
        f"![Fig. {number}]({Path(relpath(path, page.parent)).as_posix()})\n\n"
        f"*Fig. {number}: {_FIGURES[number]}.*"
        for path in made
        for number in [int(path.stem.removeprefix("figure_"))]
    ]
    write_text_atomically(text_of(rows, pictured) + "\n", page)
    return [page, *made]


def text_of(rows: Rows, pictured: Sequence[str]) -> str:
    """Return the text of the page, of which the figures are given as Markdown."""
    found = measures(rows)
    asked = read_rows(rows.folder / QUESTION)
    said, *answered = question_text(asked, found)
    paper = {f"ddpg-{name}": row.success for name, row in {**TABLE_2, **TABLE_4}.items()}
    planned = [(f"ddpg-{a}", f"ddpg-{b}") for a, b in neighbors()]
    missing = missing_runs(rows)
    sure = (
        f"{len(missing)} of the planned runs are missing, so that every number is provisional."
        if missing
        else "All planned runs of the tables are made, and their p are final."
    )
    made = answers(rows, found, decided=question_left(asked) == 0)
    training = trained(rows, asked)
    compared = [faster(training)] if question_left(asked) == 0 else []
    answer = " ".join(filter(None, [said, *(each.said for each in made), *compared]))
    head = [_QUESTION, f"**Answer.** {answer}", f"**How sure.** {sure} {_WORLDS}", CHANGED]
    claims = [list(row) for each in made for row in each.numbers]
    return "\n\n".join(
        [
            "# Does the paper's method do what the paper says?",
            "\n".join(_filled(line, bullet=True) for line in head),
            "## The paper's claims",
            _filled(_TEN),
            table(["claim", "paper", "ours"], claims),
            "## Does MPFA-PER fail less often than PER?",
            _filled(_ASKED),
            *answered,
            "## Does MPFA-PER learn faster?",
            *map(_filled, _FASTER),
            convergence_table(training),
            f"## {TITLE}",
            *(text if text.startswith("|") else _filled(text) for text in looks()),
            "## Table 2: parts of the method in the unseen world",
            unseen_table(found, TABLE_2),
            "## Table 3: steps and time of the training",
            trained_table(rows),
            _MARKED,
            _filled(_STEPS if len(rows.times) else f"{_STEPS} No run is timed yet."),
            "## Table 4: other methods in the unseen world",
            unseen_table(found, TABLE_4),
            "## Neighbors in the paper's order: the planned comparisons",
            comparison_table(found, planned, paper),
            "## Other comparisons, exploratory",
            comparison_table(found, explored(), paper),
            "## Uniform replay, and other settings",
            "Uniform replay, which the paper's tables do not have:",
            arms_table(found, {NAMES["uniform"]: "ddpg-uniform"}),
            _filled(_PHI),
            arms_table(found, OTHER_ARMS["φ"]),
            _filled(_LETTER),
            arms_table(found, OTHER_ARMS["letter"]),
            _filled(_ROBOTS),
            arms_table(found, OTHER_ARMS["robots"]),
            "## Figures",
            _filled(_PICTURES),
            *pictured,
            *filter(
                None, [errors_table(rows.folder) and _filled(_ERRORS), errors_table(rows.folder)]
            ),
            "## How to read the tables",
            *map(_filled, _READ),
            "## How the rows were made",
            _filled(_MADE),
            _COMMANDS,
            _KEPT,
            table(["file", "a row"], _FILES),
            *(["Runs that are missing:", missing_table(missing)] if missing else []),
        ]
    )


def question_text(asked: Rows, found: Mapping[str, pd.DataFrame]) -> list[str]:
    """Return a sentence for the answer, and the text of the question's section.

    Nothing is said of the runs' results before all of them are there.
    """
    planned = len(question(Path()).jobs)
    if left := question_left(asked):
        said = f"The planned test of MPFA-PER against PER waits for {left} of its {planned} runs."
        return [said, f"{planned - left} of {planned} runs are kept. None was looked at."]
    new = measures(asked)
    text, [(ratio, p), *more] = question_table(new, found)
    seen = "" if p < 0.05 else "not "
    claimed = PUBLISHED["mpfa_per"] / PUBLISHED["per"]
    where = "inside" if ratio.low <= claimed <= ratio.high else "outside of"
    beside = " and ".join(
        f"{name} fails {each.value:.2f} times as often (corrected p = {p_of:.3f})"
        for name, (each, p_of) in zip(("MPFA-PER", "PER"), more[:2], strict=True)
    )
    said = (
        f"In {len(NEW_SEEDS)} new seeds MPFA-PER fails {ratio.value:.2f} times as often as PER, "
        f"and the planned test does {seen}find a difference, p = {p:.3f}. Over seeds, the interval "
        f"is {ratio.low:.2f} to {ratio.high:.2f}. The paper's {claimed:.2f} lies {where} it, but "
        "counts collisions alone, in other worlds, and has no interval: our runs neither confirm "
        f"nor refute it. Beside uniform replay on these {TESTS} tests of one map {beside}."
    )
    parts = dict(zip(SPLIT, (p_of for _, p_of in more[4:6]), strict=True))
    found_in = [kind for kind, p_of in parts.items() if p_of < 0.05]
    if len(found_in) == 1:
        (other,) = set(parts) - set(found_in)
        said += (
            f" Of MPFA-PER's failures beside uniform replay those by {_BY[found_in[0]]} differ; "
            f"in those by {_BY[other]} no difference was found (exploratory, uncorrected)."
        )
    power = (
        "Given the failures of PER in these runs, their test finds the paper's ratio with a chance "
        f"of {question_power(new, claimed):.0%}, and one of {ratio.value:.2f} with "
        f"{question_power(new, ratio.value):.0%}."
    )
    return [said, text, _filled(power)]


def explored() -> list[tuple[str, str]]:
    """Return the pairs of arms that are compared without a plan."""
    others = [name for name in NAMES if name != "mpfa_per"]
    distant = [("mpfa_per", name) for name in others] + [("per", "uniform")]
    letter = [("mpfa_per", "per"), ("mpfa_per", "uniform"), ("per", "uniform")]
    return [
        *((f"ddpg-{a}", f"ddpg-{b}") for a, b in distant if (a, b) not in neighbors()),
        *((f"plain-{a}-letter", f"plain-{b}-letter") for a, b in letter),
        *(("ddpg-mpfa_per-phi3", f"ddpg-mpfa_per-phi{phi}") for phi in (2, 4)),
        *((f"ddpg-{name}-one_robot", f"ddpg-{name}") for name in ("mpfa_per", "per")),
    ]


def missing_runs(rows: Rows) -> list[str]:
    """Return the names of the planned runs that have no rows."""
    planned = [job.name for each in comparisons(Path()) for job in each.jobs]
    return [name for name in planned if name not in rows.runs]


def missing_table(runs: Sequence[str]) -> str:
    """Return a table of runs, a line for each arm.

    Examples:
        >>> missing_table(["ddpg-per-103", "ddpg-per-104"]).splitlines()[-1]
        '| ddpg-per | 103, 104 |'
    """
    seeds: dict[str, list[str]] = {}
    for run in runs:
        arm, _, seed = run.rpartition("-")
        seeds.setdefault(arm, []).append(seed)
    return table(["arm", "seeds"], [[arm, ", ".join(found)] for arm, found in seeds.items()])


def _filled(text: str, *, bullet: bool = False) -> str:
    """Break a paragraph into lines."""
    first, rest = ("- ", "  ") if bullet else ("", "")
    return fill(
        " ".join(text.split()),
        _WIDTH,
        initial_indent=first,
        subsequent_indent=rest,
        break_long_words=False,
        break_on_hyphens=False,
    )
