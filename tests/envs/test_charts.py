"""Charts, looked at: where lines, bands and marks are."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import stats

from mpfa_envs.render import plot_histograms, plot_seeds
from mpfa_envs.render.charts import first_step, looks, seed_band

STEPS = np.arange(0, 101, 10)


def test_a_band_is_the_interval_of_the_mean_of_runs() -> None:
    rng = np.random.default_rng(0)
    values = rng.random((5, 11))
    steps, mean, low, high = seed_band([(STEPS, each) for each in values])
    np.testing.assert_array_equal(steps, STEPS)
    expected = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    np.testing.assert_allclose(mean, values.mean(0))
    np.testing.assert_allclose(low, expected.low)
    np.testing.assert_allclose(high, expected.high)


def test_a_chart_that_cannot_be_written_whole_leaves_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(file: object) -> None:
        raise OSError(errno.ENOSPC, "no space left")

    path = tmp_path / "seeds.png"
    plot_seeds({"one": [(STEPS, STEPS)]}, path)
    before = path.read_bytes()
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="no space left"):
        plot_seeds({"two": [(STEPS, -STEPS)]}, path)
    assert path.read_bytes() == before
    assert [*tmp_path.iterdir()] == [path]


def test_a_mean_spans_the_steps_that_all_runs_have() -> None:
    curves = [([0, 10, 30], [0.0, 1.0, 1.0]), ([5, 20], [0.5, 0.5])]
    steps, mean, _, _ = seed_band(curves)
    assert steps.tolist() == [5, 10, 20]
    assert mean.tolist() == [0.5, 0.75, 0.75]


def test_a_level_is_reached_when_it_first_is() -> None:
    assert first_step(([10, 20, 30], [0.2, 0.9, 0.1]), 0.9) == 20
    assert first_step(([10, 20], [0.2, 0.8]), 0.9) == np.inf


def test_a_few_runs_are_lines_without_a_band(tmp_path: Path) -> None:
    curves = [(STEPS, np.full(11, height)) for height in (0.2, 0.5, 0.8)]
    inks = {}
    for band in ("interval", "runs"):
        plot_seeds({"one": curves}, tmp_path / "seeds.png", band=band, level=None)
        with Image.open(tmp_path / "seeds.png") as picture:
            panel = np.asarray(picture.convert("RGB"))[50:400, 300:500].astype(int)
        inks[band] = (panel.max(-1) - panel.min(-1) > 10).any(1)
    # The interval of the mean of three fills the panel; its lines are at three heights.
    assert inks["interval"].all()
    assert 1 + (np.diff(np.flatnonzero(inks["runs"])) > 1).sum() == 3


def test_a_histogram_is_darkest_where_the_numbers_are(tmp_path: Path) -> None:
    edges = np.geomspace(1e-2, 1e2, 5)
    counts = np.zeros((20, 4))
    counts[:10, 0], counts[10:, 3] = 5, 5
    path = tmp_path / "h.png"
    plot_histograms({"priority": (np.arange(20), edges, counts)}, path)
    with Image.open(path) as picture:
        gray = np.asarray(picture.convert("L")).astype(int)
    height, width = gray.shape
    panel = gray[int(0.15 * height) : int(0.78 * height), int(0.15 * width) : int(0.78 * width)]
    tall, wide = panel.shape
    corner = {
        (up, left): panel[
            slice(0, tall // 5) if up else slice(4 * tall // 5, tall),
            slice(0, wide // 4) if left else slice(3 * wide // 4, wide),
        ].mean()
        for up in (True, False)
        for left in (True, False)
    }
    assert corner[True, False] < 90 and corner[False, True] < 90
    assert corner[True, True] > 200 and corner[False, False] > 200


def test_a_method_has_its_color_and_another_arm_of_it_another_dash() -> None:
    names = ["mine", "td3/mpfa_per", "MPFA-PER, weak", "uniform replay", "PER"]
    styles = looks(names)
    assert list(styles) == names
    assert len({tuple(style.values()) for style in styles.values()}) == len(names)
    assert styles["td3/mpfa_per"]["color"] == styles["MPFA-PER, weak"]["color"]
    assert styles["td3/mpfa_per"] == looks(["MPFA-PER"])["MPFA-PER"]
    assert styles["PER"] == looks(["a", "proportional PER"])["proportional PER"]
    red, green, blue = (styles["uniform replay"]["color"][start : start + 2] for start in (1, 3, 5))
    assert red == green == blue
    assert looks(["DDPG + RAdam"], {"DDPG + RAdam": "ddpg_radam"}) != looks(["DDPG + RAdam"])
