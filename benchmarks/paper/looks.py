"""Looks at the map of the tests that are older than the rows of the page."""

from __future__ import annotations

from training.comparison.report import table

CHANGED = """
**Changed after the start.** The map of the tests had been [reported on six
times](#looks-at-the-test-map-before-these-rows) before these rows were made. Mirrored batches,
detours, the smaller clearance and the varied noise were chosen after the first look, by runs of
MPFA-PER. Failures became the measure beside success after ten seeds were seen. [Two more
changes](#how-to-read-the-tables) are older than these rows.
"""
TITLE = "Looks at the test map before these rows"
_HEAD = ["date", "commit", "runs", "MPFA-PER", "PER", "uniform", "four additions"]
_LOOKS = [
    ["2026-11-21, 10:41", "df549bf0", "seeds 10 to 12", "73.3 %", "89.7 %", "91.0 %", "before"],
    ["2026-11-21, 14:28", "ea9894df", "the same", "96.2 %", "", "", "after"],
    ["2026-11-21, 16:00", "890f6707", "the same", "96.2 %", "97.0 %", "93.8 %", "after"],
    ["2026-11-21, 20:26", "d8b4bb2b", "nine, three, three", "94.8 %", "97.0 %", "93.8 %", "after"],
    ["2026-11-22, 17:31", "79c68db9", "seeds 100 and 101", "96.8 %", "", "", "after"],
    ["2026-11-23, 02:45", "69d34f2a", "seeds 100 to 102", "97.0 %", "97.8 %", "95.7 %", "after"],
]
_BEFORE = """
Success on the same 200 pairs of start and goal, in the mean of the runs:
"""
_AFTER = (
    """
In the first report MPFA-PER reached the fewest goals. Four additions followed: half of each batch
is mirrored, four of five tasks have a detour, the clearance is smaller, and the noise varies from
episode to episode. They were chosen on the validation map and on random rooms, by runs of MPFA-PER
alone. Two runs with the varied noise were tested on this map as well, and nothing was chosen by
them. All methods have had these additions since. They are part of `regime=paper`, and so of every
run of DDPG on this page. A choice by the runs of one method may favor that method. How much is not
known, as no such choice was made for PER or uniform replay.
""",
    """
The first four reports have one robot and one update for each action. MPFA-PER had six more runs
than the others, after its first three had reached 96.2 %; three of the six had a process of its own
for the environment. TD3 with MPFA-PER was tested in the first two reports as well: 93.0 % in the
mean of three runs, both times. The seeds 100 to 102 were made again with newer code, as were all
runs of the tables. The commits have the rows.
""",
)


def looks() -> list[str]:
    """Return the paragraphs and the table of earlier looks."""
    return [_BEFORE, table(_HEAD, _LOOKS), *_AFTER]
