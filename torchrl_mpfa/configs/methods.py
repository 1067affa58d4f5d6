"""Hydra configurations of the methods, made from the catalogue: every setting is a field."""

from __future__ import annotations

from dataclasses import fields, make_dataclass
from typing import Any, get_type_hints

from torchrl.trainers.algorithms.configs.data import ReplayBufferBaseConfig

from torchrl_mpfa.configs.signatures import field_default
from torchrl_mpfa.methods import METHODS, Method, Replay, make_replay
from torchrl_mpfa.methods.assembly import has_one_batch_a_step
from torchrl_mpfa.replay import SignalReplayBuffer
from torchrl_mpfa.selection import one_batch

_PLACE = "torchrl_mpfa.configs.methods"
_BESIDE = ("storage", "device", "policy", "sigma", "generator")
"""Arguments of :func:`~torchrl_mpfa.methods.make_replay` beside the settings."""


def _config(name: str, target: str) -> type:
    """A configuration whose defaults are the settings of a method."""
    method, hints = METHODS[name], get_type_hints(Method)
    entries: list[tuple[str, Any, Any]] = []
    for setting in fields(Method):
        value = getattr(method, setting.name)
        entries.append((setting.name, hints[setting.name], field_default(value)))
    entries += [(word, Any, "auto" if word == "device" else None) for word in _BESIDE]
    entries += [("_target_", str, f"{_PLACE}.{target}"), ("_convert_", str, "all")]
    title = "".join(part.capitalize() for part in name.split("_"))
    made = make_dataclass(f"{title}Config", entries, bases=(ReplayBufferBaseConfig,))
    made.__doc__ = f"Configuration of the method ``{name}``; see :class:`Method` for its settings."
    made.__module__ = __name__
    return made


def _make_replay(**settings: Any) -> Replay:
    beside = {word: settings.pop(word) for word in _BESIDE}
    return make_replay(Method(**settings), **beside)


def _make_buffer(**settings: Any) -> SignalReplayBuffer:
    replay = _make_replay(**settings)
    if replay.select is not one_batch:
        raise ValueError(
            f"method {replay.method.name!r} chooses the batches of a step itself: take replay="
            f"{replay.method.name} and its select, as a buffer alone would train by another method"
        )
    return replay.buffer


METHOD_CONFIGS: dict[tuple[str, str], type] = {
    **{("replay", name): _config(name, "_make_replay") for name in METHODS},
    **{
        ("replay_buffer", f"signal_{name}"): _config(name, "_make_buffer")
        for name, method in METHODS.items()
        if has_one_batch_a_step(method)
    },
}
"""Every method in the group ``replay``, and as a buffer those that sample one batch a step."""
