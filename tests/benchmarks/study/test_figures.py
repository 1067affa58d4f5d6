"""The figures of a study's pages: curves, looks and bands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from benchmarks.study.designs import KEY, OF_VOLUMES
from benchmarks.study.figures import (
    looks_of,
    mean_curve,
    plot_arms,
    plot_curves,
    plot_profiles,
    plot_volumes,
)
from benchmarks.study.rows import (
    Rows,
)
from tests.benchmarks.study.test_pages import PAIRS, small_table
from tests.integration.test_figures import GRAY, ORANGE, colored


def test_a_mean_curve_begins_at_zero_and_ends_where_the_shortest_run_does() -> None:
    curves = [pd.Series([0.4, 0.8], [100, 200]), pd.Series([0.2, 0.4, 1.0], [100, 180, 300])]
    steps, mean, low, high = mean_curve(curves, np.random.default_rng(0))
    assert steps.tolist() == [0, 100, 180, 200]
    # At 200 the second one is a sixth of the way from 0.4 to 1.
    assert mean == pytest.approx([0.0, 0.3, (0.72 + 0.4) / 2, (0.8 + 0.5) / 2])
    assert (low <= mean).all() and (mean <= high).all()


def test_a_curve_is_where_its_values_are(tmp_path: Path) -> None:
    table = small_table(tmp_path)
    steps = np.arange(1000, 10_001, 1000)
    curves = [
        pd.DataFrame({"arm": arm, "seed": seed, "total_steps": steps, "success": height})
        for arm, height in (("s/td3/per", 0.9), ("s/td3/uniform", 0.3))
        for seed in (0, 1)
    ]
    plot_curves(table, Rows(pd.concat(curves), pd.DataFrame()), tmp_path / "c.png")
    # The one panel has both: uniform replay, with which it is compared, is gray.
    uniform, per = (colored(tmp_path / "c.png", color) for color in (GRAY, ORANGE))
    middle = slice(None), slice(per.shape[1] // 2, None)
    assert np.median(np.nonzero(per[middle])[0]) < np.median(np.nonzero(uniform[middle])[0]) - 50


def test_a_method_has_the_same_look_whichever_others_stand_beside_it() -> None:
    for learner, names in (
        ("td3", ["uniform", "per", "mpfa_plus"]),
        # A method is called so as well.
        ("ddpg", ["uniform", "per", "mpfa_plus"]),
        ("td3", ["geometric", "mpfa_plus", "uniform", "lap", "lap/median"]),
    ):
        labels = [f"s/{learner}/{name}" for name in names]
        found = looks_of(labels, {label: [0] for label in labels})
        looks = {label.split("/", 2)[2]: number for number, _, label in found}
        assert looks["uniform"] == 0 and looks["mpfa_plus"] == KEY.index("mpfa_plus")
        assert len(set(looks.values())) == len(labels)


def test_the_band_of_a_profile_ends_with_its_runs(tmp_path: Path) -> None:
    table = replace(small_table(tmp_path), panels={"all": PAIRS[0][::-1]})
    scores = {"s/td3/uniform": pd.DataFrame({"area": np.linspace(0.1, 0.3, 9)})}
    plot_profiles(table, scores, tmp_path / "p.png")
    with Image.open(tmp_path / "p.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    # Pale blue: less red than a grid line, which is gray.
    band = (pixels[..., 2] - pixels[..., 0] > 15) & (pixels.min(-1) > 150)
    columns = np.flatnonzero(band[:-60].sum(0) > 8)
    assert columns.max() < 0.5 * band.shape[1]


def test_a_title_wider_than_its_panel_is_whole(tmp_path: Path) -> None:
    arms = tuple(f"s/td3/per/{'long' * 6}_{name}" for name in "ab")
    titles = ("effective sample of 80%", "effective sample of 50%")
    table = replace(small_table(tmp_path), panels=dict.fromkeys(titles, arms))
    plot_arms(table, {arm: pd.DataFrame({"area": [0.1, 0.3]}) for arm in arms}, tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as picture:
        assert np.asarray(picture.convert("L"))[:, -3:].min() == 255


def test_where_a_method_is_better_than_uniform_replay_the_map_is_blue(tmp_path: Path) -> None:
    scores = {
        f"sparse/td3/{method}": pd.DataFrame({"area": [0.5 + 0.2 * (method == "per")] * 2})
        for method in OF_VOLUMES[32]
    }
    scores["sparse/td3/lap"] = pd.DataFrame({"area": [0.3, 0.3]})
    scores["sparse/td3/geometric"] = pd.DataFrame({"area": [0.0]})  # One run shows nothing.
    plot_volumes(scores, tmp_path / "v.png")
    # The ends of the color map, in the one column and the five rows that have runs to compare.
    rows = []
    for color in ((5, 48, 97), (103, 0, 31)):
        marked = colored(tmp_path / "v.png", color)
        # The bar of the scale is right of the map.
        lines, columns = np.nonzero(marked[:, : int(0.8 * marked.shape[1])])
        assert columns.max() - columns.min() > 0.4 * marked.shape[1]
        rows.append(np.median(lines) / marked.shape[0])
    assert 0.42 < rows[1] - rows[0] < 0.47
    assert colored(tmp_path / "v.png", (217, 217, 217)).mean() < 0.02
