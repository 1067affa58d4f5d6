"""The figures of the methods: what is counted, and that every page has one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from benchmarks import sampling
from benchmarks.sampling import COLORS, KINDS, PICTURED, count_samples, main, samples_uniformly
from torchrl_mpfa.methods import ALIASES

DOCS = Path(__file__).parents[2] / "docs" / "methods"
NAMES = sorted(set(PICTURED) - set(ALIASES))


@pytest.fixture(autouse=True)
def few_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling, "COUNT", 400)
    monkeypatch.setattr(sampling, "ROUNDS", 60)


def means_by_kind(name: str, who: str = "critic") -> dict[str, float]:
    transitions, found = count_samples(PICTURED[name])
    return {
        kind: float(found[who][transitions.kind == number].mean())
        for number, kind in enumerate(KINDS)
    }


def test_per_favors_large_errors_and_mpfa_per_goals_as_well() -> None:
    transitions, found = count_samples(PICTURED["per"])
    error = transitions.signals["td_error"].numpy()
    high = error > np.median(error)
    assert found["critic"][high].mean() > 1.3 * found["critic"][~high].mean()
    per, mpfa = means_by_kind("per"), means_by_kind("mpfa_per")
    assert mpfa["goal"] > 1.3 * per["goal"]
    assert mpfa["approaching"] > mpfa["moving away"]


def test_la3p_gives_the_actor_small_errors_and_the_critic_large_ones() -> None:
    transitions, found = count_samples(PICTURED["la3p"])
    error = transitions.signals["td_error"].numpy()
    large = error > np.quantile(error, 0.95)
    assert found["critic"][large].mean() > 1.1 > 0.97 > found["actor"][large].mean()


def test_combined_replay_has_the_newest_in_every_batch() -> None:
    _, found = count_samples(PICTURED["cer"])
    assert found["critic"].argmax() == len(found["critic"]) - 1


def test_a_reliable_error_is_sampled_more_often_than_one_early_in_its_episode() -> None:
    _, found = count_samples(PICTURED["reaper"])
    by_step = found["critic"].reshape(-1, sampling.EPISODE_LENGTH).mean(0)
    assert by_step[-10:].mean() > 1.2 * by_step[:10].mean()


def test_the_capped_replay_lets_go_of_what_it_sampled_most() -> None:
    capped, per = means_by_kind("mw"), means_by_kind("td_reward")
    assert capped["goal"] < per["goal"]


def test_the_bars_of_a_figure_are_as_high_as_what_they_count(tmp_path: Path) -> None:
    assert main(["per", "--output", str(tmp_path)]) == 0
    with Image.open(tmp_path / "per.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    # The middle panel, without the legend above it.
    bars = pixels[pixels.shape[0] // 5 :, pixels.shape[1] // 3 : 2 * pixels.shape[1] // 3]
    counted = means_by_kind("per")
    height = {}
    for kind, color in zip(KINDS, COLORS, strict=True):
        filled = (abs(bars - 255 * np.array(to_rgb(color))) <= 2).all(-1)
        height[kind] = int(filled.sum(0).max())
    for kind in KINDS[1:]:
        ratio = height[kind] / height[KINDS[0]]
        assert ratio == pytest.approx(counted[kind] / counted[KINDS[0]], rel=0.05)


def page_of(name: str) -> str:
    """The page of a method; parts and baselines share one."""
    own = DOCS / f"{name}.md"
    return (own if own.exists() else DOCS / "baselines.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", NAMES)
def test_every_method_has_a_page_with_its_source_and_a_figure_unless_it_is_uniform(
    name: str,
) -> None:
    page = page_of(name)
    pictured = not samples_uniformly(PICTURED[name])
    assert (f"(images/{name}.png)" in page) == pictured
    assert (DOCS / "images" / f"{name}.png").exists() == pictured
    shared = f"## `{name}`\n" in page
    for part in ("doi.org",) if shared else ("## Formula", "| source |"):
        assert part in page
    overview = (DOCS / "README.md").read_text(encoding="utf-8")
    link = f"baselines.md#{name}" if shared else f"{name}.md"
    assert f"[`{name}`]({link})" in overview
    assert "examples/train.py method=NAME" in overview


@pytest.mark.parametrize("name", ["klper", "averaged_ddpg", "geometric", "hvper", "mw", "rud"])
def test_a_reconstruction_is_called_one(name: str) -> None:
    assert "reconstruction" in page_of(name).lower()
