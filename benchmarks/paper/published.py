"""Numbers that the paper publishes, and the names of its methods."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple


class Tested(NamedTuple):
    """A row of Tables 2 and 4: 200 tests in the unseen world."""

    collisions: int
    success: float
    time: float
    """Mean time of a test [s]."""


class Trained(NamedTuple):
    """A row of Table 3: training for 1,000 episodes in the worlds A to D."""

    minutes: int
    steps: int


RECONSTRUCTED = ("klper", "ddpg_radam", "hvper", "averaged_ddpg", "mw")
"""Methods of others of which too little is published: ours say nothing about the originals."""
MARK = "†"
"""Stands behind the name of what is, or rests on, a reconstruction."""
_NAMES = {
    "mpfa_per": "MPFA-PER",
    "per": "PER",
    "td_reward": "TD-error + reward",
    "td_loss": "TD-error + loss",
    "mpf_per": "MPF-PER",
    "raise": "Raise priority",
    "decay": "Decay priority",
    "klper": "KLPER",
    "ddpg_radam": "DDPG + RAdam",
    "hvper": "HVPER",
    "averaged_ddpg": "Averaged-DDPG",
    "mw": "MW-MADDPG",
    "uniform": "uniform",
}
NAMES = {name: text + MARK * (name in RECONSTRUCTED) for name, text in _NAMES.items()}
"""The paper's names of the methods. No table of the paper has uniform replay."""
TESTS = 200
"""Tests of each method in Tables 2 and 4."""
TABLE_2 = {
    "per": Tested(29, 0.855, 31.8),
    "td_reward": Tested(24, 0.880, 30.1),
    "td_loss": Tested(25, 0.875, 30.5),
    "mpf_per": Tested(21, 0.895, 28.2),
    "raise": Tested(22, 0.890, 30.3),
    "decay": Tested(23, 0.885, 29.8),
    "mpfa_per": Tested(19, 0.905, 27.3),
}
TABLE_3 = {
    "klper": Trained(1284, 219_318),
    "ddpg_radam": Trained(1589, 224_048),
    "hvper": Trained(2082, 247_043),
    "averaged_ddpg": Trained(1522, 222_569),
    "mw": Trained(1675, 233_047),
    "mpfa_per": Trained(994, 213_627),
}
TABLE_4 = {
    "klper": Tested(24, 0.880, 29.4),
    "ddpg_radam": Tested(25, 0.875, 31.5),
    "hvper": Tested(27, 0.865, 34.2),
    "averaged_ddpg": Tested(28, 0.860, 30.9),
    "mw": Tested(27, 0.865, 32.8),
    "mpfa_per": Tested(19, 0.905, 27.3),
}
PHIS = (2, 3, 4)
"""Values of φ in Fig. 5."""
CURVES = {
    8: ("per", "td_reward", "td_loss", "mpf_per"),
    9: ("per", "raise"),
    10: ("per", "raise", "decay"),
    11: ("mpfa_per", "per", "mpf_per", "raise", "decay"),
}
"""Methods of the figures of reward by map. Figs. 10 and 11: those that the text names."""


def in_order(rows: Mapping[str, Tested]) -> list[str]:
    """Sort the methods of a table from the most successful one, ties by the shorter time."""
    return sorted(rows, key=lambda name: (-rows[name].success, rows[name].time))


def neighbors(*tables: Mapping[str, Tested]) -> list[tuple[str, str]]:
    """Return the pairs of neighbors in the order of each table, by default of Tables 2 and 4."""
    return [pair for rows in tables or (TABLE_2, TABLE_4) for pair in pairwise(in_order(rows))]
