"""ONNX files of policies: the same actions, a card that fits, and what is rejected."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("onnx", reason="exported policies are of the extra onnx")

from mpfa_envs import Policy, export_policy, load_policy, save_policy
from mpfa_envs.deploy import CardError, Pilot
from mpfa_envs.policies.layers import Choice, Clip, Linear, ReLU, Scale, Table, Tanh
from mpfa_envs.policies.policy import PolicyFileError
from mpfa_envs.sensing.observation import Binning
from tests.envs.exported import SHIPPED, exported, make_policy


def observations(count: int = 1000, size: int = 24) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (count, size)).astype(np.float32)


def change_card(file: Path, **values: Any) -> None:
    card = file.with_suffix(".json")
    card.write_text(json.dumps(json.loads(card.read_text()) | values))


def test_it_chooses_what_the_policy_chooses(tmp_path: Path) -> None:
    policy = load_policy(SHIPPED)
    found = load_policy(export_policy(policy, tmp_path / "policy.onnx"))(observations())
    assert found.dtype == np.float32 and np.ptp(found, axis=0).min() > 0.5
    np.testing.assert_allclose(found, policy(observations()), rtol=0, atol=1e-6)


def test_scaled_actions_and_choices_are_the_same_too(tmp_path: Path) -> None:
    weight = np.random.default_rng(2).normal(size=(3, 24)).astype(np.float32)
    linear = Linear(weight, np.zeros(3, np.float32))
    pairs = np.array([[-1, 1], [1, 1], [1, -1]], np.float32)
    bounds = Scale(center=np.array([0.5, 0.1], np.float32), half=np.array([0.5, 2], np.float32))
    clip = Clip(low=np.array([0.2, -1], np.float32), high=np.array([0.6, 0.5], np.float32))
    last = Linear(weight[:2, :3], np.zeros(2, np.float32))
    for number, layers in enumerate(
        (
            [linear, Choice(pairs)],
            [linear, ReLU(), last, Tanh(), bounds],
            [linear, ReLU(), last, Tanh(), bounds, clip],
        )
    ):
        policy = Policy(layers)
        found = load_policy(export_policy(policy, tmp_path / f"{number}.onnx"))
        np.testing.assert_allclose(found(observations()), policy(observations()), atol=1e-6)


def test_a_quantized_action_depends_on_its_own_observation_alone(tmp_path: Path) -> None:
    policy = load_policy(SHIPPED)
    small = export_policy(policy, tmp_path / "small.onnx", quantize=True)
    large = export_policy(policy, tmp_path / "large.onnx")
    assert small.stat().st_size < 0.4 * large.stat().st_size
    quantized, seen = load_policy(small), observations()
    together = quantized(seen)
    assert 1e-6 < np.abs(together - policy(seen)).max() < 0.3
    np.testing.assert_array_equal(quantized(seen[7]), together[7])


def test_the_card_says_what_a_robot_must_know(tmp_path: Path) -> None:
    file = export_policy(make_policy(), tmp_path / "policy.onnx", results=[{"success": 0.9}])
    card = json.loads((tmp_path / "policy.json").read_text())
    assert card["observation"]["parts"][1] == {
        "name": "goal_direction",
        "first": 18,
        "size": 2,
        "meaning": "cosine and sine of the goal's direction in the robot's frame",
    }
    assert card["scales"]["closeness_distance"] == 0.23
    assert card["limits"]["period"] == 0.2 and card["robot"]["wheel_base"] == 0.23
    assert card["training"] == {"seed": 3} and card["results"] == [{"success": 0.9}]
    loaded = load_policy(file)
    assert (loaded.card, loaded.env_arguments) == ({"seed": 3}, make_policy().env_arguments)
    assert loaded.env_arguments["robot"] == card["robot"]


def test_a_policy_of_other_layers_or_senses_is_not_exported(tmp_path: Path) -> None:
    cells = {name: getattr(Binning(), name) for name in Binning.__dataclass_fields__}
    table = Policy([Table(values=np.zeros((Binning().cells, 2), np.float32), **cells)])
    for policy, message in (
        (table, "a Table is no network"),
        (make_policy(memory="map"), "observation.size must be 27, of 18 sectors"),
        (make_policy(history=2), "observation.size must be 60"),
    ):
        with pytest.raises(CardError, match=message):
            export_policy(policy, tmp_path / "policy.onnx")
    with pytest.raises(ValueError, match=r"path must end in \.onnx, got"):
        export_policy(make_policy(), tmp_path / "policy.npz")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sha256": "0"}, "is the card of another file"),
        ({"format": 2}, "format must be 1, got 2"),
        ({"memory": "map"}, "observation.size must be 27"),
        ({"memory": "long"}, "memory must be"),
        ({"history": -1}, "history must be an integer of at least 0, got -1"),
        ({"robot": {}}, "the card does not fit: robot must have all its fields"),
        ({"limits": {}}, "the card has no 'period'"),
        ({"scales": {"goal_closeness_distance": 0.4}}, "goal_closeness_distance must be 0.3"),
        ({"observation": {"size": 12}, "lidar": {}}, "the card has no 'sectors'"),
    ],
)
def test_a_card_that_does_not_fit_is_rejected(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    file = exported(tmp_path)
    change_card(file, **change)
    with pytest.raises(PolicyFileError, match=message):
        load_policy(file)


def test_weights_that_lie_in_another_file_are_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import onnx

    file = exported(tmp_path)
    model = onnx.load(file)
    onnx.external_data_helper.convert_model_to_external_data(
        model, location="innocent.bin", size_threshold=0
    )
    monkeypatch.chdir(tmp_path)  # Where onnxruntime looks for what is not in the file.
    onnx.save(model, file)
    assert (tmp_path / "innocent.bin").exists()
    change_card(file, sha256=hashlib.sha256(file.read_bytes()).hexdigest())
    for load in (load_policy, Pilot.load):
        with pytest.raises(ValueError, match="the network must hold its weights, and this one nam"):
            load(file)


def test_a_missing_or_damaged_file_is_told(tmp_path: Path) -> None:
    file = exported(tmp_path)
    with pytest.raises(FileNotFoundError, match="there is no policy at"):
        load_policy(tmp_path / "other.onnx")
    file.write_bytes(b"no network")
    with pytest.raises(PolicyFileError, match="is the card of another file"):
        load_policy(file)
    card = tmp_path / "policy.json"
    for damaged in ("{", "[" * 100_000):
        card.write_text(damaged)
        with pytest.raises(PolicyFileError, match="is no card of a policy"):
            load_policy(file)
    card.unlink()
    with pytest.raises(FileNotFoundError, match="there is no card of the policy at"):
        load_policy(file)


def test_an_exported_policy_is_not_saved_as_another_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"policy must have layers, got OnnxPolicy\(24 -> 2\)"):
        save_policy(load_policy(exported(tmp_path)), tmp_path)
