from __future__ import annotations

import math

from benchmarks.speed.environment import measure


def test_the_benchmark_reports_what_it_promises() -> None:
    entries = {entry["name"]: entry for entry in measure(seconds=0.02)}
    assert {
        "env_wheels",
        "env_kinematic",
        "env_wheels_physics_share",
        "env_kinematic_physics_share",
        "torchrl_env",
    } <= set(entries)
    for entry in entries.values():
        assert set(entry) == {"name", "value", "unit", "ratio", "baseline"}
        assert math.isfinite(entry["value"]) and entry["value"] > 0
        assert (entry["ratio"] is None) == (entry["baseline"] is None)
        if entry["baseline"]:
            assert entry["ratio"] == entry["value"] / entries[entry["baseline"]]["value"]
    shares = [entry["value"] for name, entry in entries.items() if name.endswith("share")]
    assert all(0.0 < share < 1.0 for share in shares)
