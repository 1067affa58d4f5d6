"""Hydra configurations of the methods, made from the catalogue: every setting is a field."""

from __future__ import annotations

from dataclasses import fields, make_dataclass
from typing import Any, get_type_hints

from torchrl.trainers.algorithms.configs.data import ReplayBufferBaseConfig

from torchrl_mpfa.buffer import SignalReplayBuffer
from torchrl_mpfa.configs.signatures import field_default
from torchrl_mpfa.methods import METHODS, Replay, make_replay

_PLACE = "torchrl_mpfa.configs.methods"
_BESIDE = ("storage", "device", "policy", "sigma", "generator")
"""Arguments of :func:`~torchrl_mpfa.methods.make_replay` beside the settings."""


def _config(name: str, target: str) -> type:
    """Make a configuration whose defaults are the settings of a method."""
    method = METHODS[name]
    hints = get_type_hints(type(method))
    entries: list[tuple[str, Any, Any]] = []
    for setting in fields(method):
        value = name if setting.name == "name" else getattr(method, setting.name)
        entries.append((setting.name, hints[setting.name], field_default(value)))
    entries += [(word, Any, "auto" if word == "device" else None) for word in _BESIDE]
    entries += [("_target_", str, f"{_PLACE}.{target}"), ("_convert_", str, "all")]
    title = "".join(part.capitalize() for part in name.split("_"))
    made = make_dataclass(f"{title}Config", entries, bases=(ReplayBufferBaseConfig,))
    kind = type(method).__name__
    made.__doc__ = f"Configuration of the method ``{name}``; see :class:`{kind}` for its settings."
    made.__module__ = __name__
    return made


def _make_replay(name: str, **settings: Any) -> Replay:
    return make_replay(name, **settings)


def _make_buffer(name: str, **settings: Any) -> SignalReplayBuffer:
    return make_replay(name, **settings).buffer


METHOD_CONFIGS: dict[tuple[str, str], type] = {
    **{("replay", name): _config(name, "_make_replay") for name in METHODS},
    **{
        ("replay_buffer", f"signal_{name}"): _config(name, "_make_buffer")
        for name, method in METHODS.items()
        if method.plain
    },
}
"""Every method in the group ``replay``, and as a buffer those that sample one batch a step."""
