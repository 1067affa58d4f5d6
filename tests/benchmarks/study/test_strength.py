"""How strongly methods prioritize: short runs, and the table on the page of the results."""

from pathlib import Path

import pandas as pd
import torch

from benchmarks.study import strength

ROOT = Path(__file__).parents[3]


def test_a_run_is_measured_on_the_way_and_not_made_twice(tmp_path, monkeypatch, capsys):
    stages = "curriculum.stages=[{world: mixed, actions: 320}]"
    settings = [stages if each.startswith("curriculum") else each for each in strength.SPARSE]
    monkeypatch.setattr(strength, "SPARSE", settings)
    monkeypatch.setattr(strength, "MARKS", (288, 320))
    states, measure = [], strength.measure

    def watched(run):
        states.append(torch.get_rng_state())
        found = measure(run)
        assert states[-1].equal(torch.get_rng_state())  # What it looks at goes on as without.
        return found

    monkeypatch.setattr(strength, "measure", watched)
    asked = ["--methods", "mpfa_per", "--seeds", "5", "--output", str(tmp_path)]
    assert strength.main(asked) == 0
    path = tmp_path / "strength.csv"
    rows = pd.read_csv(path)
    assert len(states) == 2
    assert rows["actions"].tolist() == [288, 320]
    assert rows["effective"].between(0.05, 0.95).all()
    # Without a goal the reward has all the weight.
    assert (rows["reward_weight"] == 1).tolist() == (rows["goals"] == 0).tolist()
    assert rows["td_error"].between(0, 5, inclusive="neither").all()
    assert rows["mirror"].between(-1, 0.999).all()
    before = path.read_bytes()
    capsys.readouterr()
    assert strength.main(asked) == 0
    assert path.read_bytes() == before
    assert "| mpfa_per | 1.00 [1.00, 1.00] | 1.00 [1.00, 1.00] |" in capsys.readouterr().out


def test_the_page_has_the_table_of_the_kept_rows():
    rows = pd.read_csv(ROOT / "docs/results/strength.csv")
    page = (ROOT / "docs/results.md").read_text(encoding="utf-8")
    for table in strength.tables_of(rows).split("\n\n"):
        assert table in page
