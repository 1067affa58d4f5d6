"""Policies in NumPy: equal to the network, and a file that is right or rejected."""

from __future__ import annotations

import io
import json
import os
import zipfile
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from mpfa_envs import ROBOTS, Policy, load_policy, save_policy
from mpfa_envs.policies.layers import Linear
from mpfa_envs.policies.policy import PolicyFileError

ENV_ARGUMENTS = {"robot": "turtlebot2", "physics": "kinematic", "action_repeat": 2}
KEPT = {**ENV_ARGUMENTS, "robot": json.loads(json.dumps(asdict(ROBOTS["turtlebot2"])))}
"""The same as a policy keeps them."""


class ToBounds(nn.Module):
    """A map to the bounds of actions, as a policy may end with."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("center", torch.tensor([1.0, -3.0]))
        self.register_buffer("half_range", torch.tensor([0.5, 2.0]))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.center + self.half_range * x


def make_layers() -> list[nn.Module]:
    layers = [
        nn.Linear(24, 64), nn.LayerNorm(64), nn.ReLU(),
        nn.Linear(64, 32), nn.LayerNorm(32, eps=1e-3), nn.Identity(), nn.Tanh(),
        nn.Linear(32, 2), nn.Tanh(), ToBounds(),
    ]  # fmt: skip
    for layer in layers:
        if isinstance(layer, nn.LayerNorm):
            nn.init.uniform_(layer.weight, 0.5, 2.0)
            nn.init.normal_(layer.bias)
    return layers


def make_policy() -> Policy:
    return Policy.from_layers(make_layers(), card={"seed": 3}, env_arguments=ENV_ARGUMENTS)


def observations(count: int = 1000) -> np.ndarray:
    return np.random.default_rng(0).uniform(-2, 2, (count, 24)).astype(np.float32)


def test_it_chooses_what_the_network_chooses() -> None:
    layers = make_layers()
    policy = Policy.from_layers(layers)
    seen = observations()
    with torch.no_grad():
        expected = nn.Sequential(*layers)(torch.from_numpy(seen)).numpy()
    found = policy(seen)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
    assert np.ptp(expected, axis=0).min() > 0.1  # The network does not say the same to all.


class Reached(ToBounds):
    """Bounds that are reached, and clipped, before the tanh has its end."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        ends = self.center - self.half_range, self.center + self.half_range
        return super().forward(x / 0.4).clamp(*ends)


def test_bounds_that_are_reached_before_the_end_of_the_tanh_are_kept(tmp_path: Path) -> None:
    layers = [*make_layers()[:-1], Reached()]
    policy, seen = Policy.from_layers(layers), observations()
    with torch.no_grad():
        layers[-3].weight.mul_(20.0)
        policy = Policy.from_layers(layers)
        expected = nn.Sequential(*layers)(torch.from_numpy(seen)).numpy()
    assert [type(layer).__name__ for layer in policy.layers[-3:]] == ["Tanh", "Scale", "Clip"]
    loaded = load_policy(save_policy(policy, tmp_path))
    for driver in (policy, loaded):
        np.testing.assert_allclose(driver(seen), expected, rtol=0, atol=1e-4)
    for bound in (expected.min(0), expected.max(0)):
        assert ((expected == bound).mean(0) > 0.01).all()


@pytest.mark.parametrize("at_once", [1, 3, 16, 17, 999])
def test_an_action_does_not_depend_on_what_else_is_asked(at_once: int) -> None:
    policy, seen = make_policy(), observations()
    together = policy(seen)
    apart = [policy(seen[i : i + at_once]) for i in range(0, len(seen), at_once)]
    assert np.concatenate(apart).tobytes() == together.tobytes()


@pytest.mark.parametrize("shape", [(24,), (5, 24), (2, 3, 24), (0, 24)])
def test_observations_may_have_any_batch(shape: tuple[int, ...]) -> None:
    assert make_policy()(np.zeros(shape, np.float32)).shape == (*shape[:-1], 2)


@pytest.mark.parametrize("shape", [(), (23,), (24, 5)])
def test_observations_of_another_size_are_rejected(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"observation must have shape \[\.\.\., 24\], got"):
        make_policy()(np.zeros(shape, np.float32))


def test_a_file_restores_policy_card_and_arguments(tmp_path: Path) -> None:
    policy = make_policy()
    assert save_policy(policy, tmp_path) == tmp_path / "policy.npz"
    assert [path.name for path in tmp_path.iterdir()] == ["policy.npz"]
    for path in (tmp_path, tmp_path / "policy.npz", str(tmp_path)):
        loaded = load_policy(path)
        assert loaded(observations(9)).tobytes() == policy(observations(9)).tobytes()
        assert (loaded.card, loaded.env_arguments) == ({"seed": 3}, KEPT)


def test_a_write_that_fails_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = save_policy(make_policy(), tmp_path)
    before = file.read_bytes()

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        save_policy(Policy.from_layers(make_layers()), tmp_path)
    assert file.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["policy.npz"]


def test_every_flipped_bit_is_noticed_or_changes_nothing(tmp_path: Path) -> None:
    policy = make_policy()
    file = save_policy(policy, tmp_path)
    whole, expected = file.read_bytes(), policy(observations(50)).tobytes()
    # Half of them where the structure is: headers and the list of contents at the end.
    rng = np.random.default_rng(0)
    places = [*rng.integers(len(whole), size=300), *rng.integers(1, 1500, size=300) * -1]
    noticed = 0
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        file.write_bytes(damaged)
        try:
            loaded = load_policy(file)
        except PolicyFileError as error:
            assert str(file) in str(error)
            noticed += 1
        else:
            assert loaded(observations(50)).tobytes() == expected
            assert (loaded.card, loaded.env_arguments) == (policy.card, KEPT)
    assert noticed > 400


def packed(**arrays: object) -> bytes:
    content = io.BytesIO()
    np.savez(content, **arrays)  # type: ignore[arg-type]
    return content.getvalue()


def about(**changes: object) -> np.ndarray:
    plain = {"format": 1, "layers": [{"kind": "Linear"}], "card": {}, "env_arguments": {}}
    return np.frombuffer(json.dumps({**plain, **changes}).encode(), np.uint8)


LAYER = {"0.weight": np.zeros((2, 24), np.float32), "0.bias": np.zeros(2, np.float32)}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"hello", "not a zip file"),
        (packed(a=np.zeros(3)), "about"),
        (packed(about=about(format=2), **LAYER), "format is 2, not 1"),
        (packed(about=about(layers=[{"kind": "Dropout"}])), "Dropout"),
        (packed(about=about()), "missing"),
        (packed(about=about(layers=[{"kind": "ReLU"}])), "begin with a linear layer"),
        (packed(about=about(), **{**LAYER, "0.bias": np.zeros(3)}), r"shape \[2\], got \(3,\)"),
        (packed(about=about(), **{**LAYER, "0.bias": np.full(2, np.nan)}), "bias is not finite"),
        (packed(about=np.array([object()])), "allow_pickle=False"),
    ],
)
def test_a_foreign_file_is_rejected_with_the_reason(
    tmp_path: Path, content: bytes, message: str
) -> None:
    file = tmp_path / "foreign.npz"
    file.write_bytes(content)
    with pytest.raises(PolicyFileError, match=message) as caught:
        load_policy(file)
    assert "foreign.npz" in str(caught.value)


def test_a_file_that_unpacks_to_much_is_rejected_unread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mpfa_envs.policies.policy._LARGEST", 1000)
    file = tmp_path / "large.npz"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("about.npy", b"\0" * 1001)
    with pytest.raises(PolicyFileError, match="it unpacks to 1001 bytes"):
        load_policy(file)


def test_a_policy_of_the_package_is_found_by_its_name_unless_there_is_such_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shipped = load_policy("td3-rooms")
    Path("td3-rooms").mkdir()
    with pytest.raises(FileNotFoundError, match="those that come with the package are ddpg-"):
        load_policy("td3-rooms")
    save_policy(load_policy("td3-paper"), "td3-rooms")
    assert shipped.observation_size == 45
    assert load_policy("td3-rooms").observation_size == 24


def test_a_file_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"there is no policy at .*policy\.npz"):
        load_policy(tmp_path)


@pytest.mark.parametrize(
    ("layers", "message"),
    [
        ([], "layers must begin with a linear layer"),
        ([nn.Tanh()], "layers must begin with a linear layer"),
        ([nn.Linear(24, 8), nn.Linear(9, 2)], r"layer 1, Linear: weight must have shape .*8\]"),
        ([nn.Linear(24, 8), nn.LayerNorm(9)], r"layer 1, LayerNorm: weight must have shape \[8\]"),
        ([nn.Linear(24, 8), nn.Sigmoid()], "layers must be among .*got Sigmoid"),
        ([nn.Linear(24, 8), nn.Tanh(), nn.ELU()], "layers must be among .*got ELU"),
        ([nn.Linear(24, 8), nn.Tanh(), "tanh"], "layers must be among .*got 'tanh'"),
        (
            [nn.Linear(24, 8), nn.LayerNorm(8, bias=False)],
            "LayerNorm must be of one dimension with bias",
        ),
    ],
)
def test_layers_that_do_not_fit_are_named(layers: list[nn.Module], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Policy.from_layers(layers)


@pytest.mark.parametrize("card", [{"a": object()}, {"a": float("nan")}])
def test_a_card_must_be_plain(card: dict[str, object]) -> None:
    layer = Linear(np.zeros((2, 24), np.float32), np.zeros(2, np.float32))
    with pytest.raises(ValueError, match="card must hold plain values"):
        Policy([layer], card=card)
    with pytest.raises(ValueError, match="env_arguments must hold plain values"):
        Policy([layer], env_arguments=card)
