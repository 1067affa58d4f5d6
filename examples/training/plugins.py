"""Plugins: a file of one's own that is imported first, and the signals that it registers."""

from __future__ import annotations

import os
import sys
import traceback
from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Callable, Iterable, Sequence
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import TYPE_CHECKING, Any

from training.files import digest

if TYPE_CHECKING:
    from tensordict import TensorDictBase
    from torch import Tensor

SignalFunction = Callable[..., Any]
"""From a learner and a batch to a signal, shape ``[B]``."""
OF_LOSSES = (
    *("reward", "td_error", "action_gradient", "value"),
    *("relative_value", "relative_td_error", "information_gain"),
)
"""Signals that the losses of ``train.py`` write."""
SIGNALS: dict[str, SignalFunction | type[SignalFunction]] = {}
"""Signals of plugins by name; :func:`register_signal` adds one."""
_WORD = "plugin="


def register_signal(name: str, signal: SignalFunction | type[SignalFunction]) -> None:
    """Add a signal, for this process.

    Args:
        name: Its name, in the ``signals`` of a method.
        signal: Function from a learner and a batch of ``[B]`` transitions to non-negative numbers,
            shape ``[B]``; or a class of such objects, of which each run makes one. What its
            ``state_dict()`` gives, if it has one, is saved with the run.

    Raises:
        TypeError: If the signal cannot be called.
        ValueError: If a loss has a signal of this name.

    Examples:
        >>> def size(learner, batch):
        ...     return batch["action"].square().sum(-1)
        >>> register_signal("size", size)  # doctest: +SKIP
    """
    if not callable(signal):
        raise TypeError(f"signal must be a function or a class, got {signal!r}")
    if not name or name in OF_LOSSES:
        raise ValueError(f"name must be one that no loss has, got {name!r}")
    SIGNALS[name] = signal


def load_plugin(path: str | Path) -> str:
    """Import a plugin, unless this process has done so.

    Returns:
        Its absolute path.

    Raises:
        ValueError: If there is no such file, an error ended it, or what it registered cannot be.
    """
    file = Path(path).resolve()
    if not os.path.isfile(file) or file.suffix != ".py":
        raise ValueError(f"plugin must be a Python file, got {path}")
    # By its name, as processes of Ray look for what it defines.
    there, known = sys.modules.get(file.stem), digest(file)
    if there is not None and getattr(there, "PLUGIN", None) == known:
        return str(file)
    if there is not None and Path(getattr(there, "__file__", None) or "").resolve() != file:
        raise ValueError(f"plugin must have a name that no module has, got {path}")
    spec = spec_from_file_location(file.stem, file)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[file.stem] = module
    try:
        spec.loader.exec_module(module)
        _check_methods()
    except Exception as error:
        del sys.modules[file.stem]
        lines = [
            each.lineno
            for each in traceback.extract_tb(error.__traceback__)
            if each.filename == str(file)
        ]
        where = f"{path}:{lines[-1]}" if lines else str(path)
        raise ValueError(f"plugin {where}: {type(error).__name__}: {error}") from error
    module.PLUGIN = known  # type: ignore[attr-defined]
    return str(file)


def _check_methods() -> None:
    """Raise if a method is registered by another name than its own."""
    from torchrl_mpfa.methods import ALIASES, METHODS

    for name, method in METHODS.items():
        if method.name != ALIASES.get(name, name) and method.name != name:
            raise ValueError(f"METHODS[{name!r}] must have this name, got {method.name!r}")


def add_plugin(parser: ArgumentParser) -> None:
    """Add the option ``--plugin``, which is loaded while the command line is parsed."""

    def loaded(text: str) -> str:
        try:
            return load_plugin(text)
        except ValueError as error:
            raise ArgumentTypeError(str(error)) from error

    parser.add_argument(
        "--plugin",
        type=loaded,
        metavar="FILE",
        help="file with methods, signals, robots or generators of your own",
    )


def plugin_words(arguments: Iterable[str]) -> list[str]:
    """Return the words of a command line that name a plugin.

    Examples:
        >>> plugin_words(["seed=1", "plugin=mine.py"])
        ['plugin=mine.py']
    """
    return [text for text in arguments if text.startswith(_WORD)]


def with_plugin(
    arguments: Sequence[str], plugin: str | None = None
) -> tuple[list[str], str | None]:
    """Load the plugin that settings of ``train.py`` name.

    Args:
        arguments: The settings; ``--plugin FILE`` is the same as ``plugin=FILE``.
        plugin: That of another option.

    Returns:
        The settings, and the plugin's absolute path, which they have.
    """
    words = list(arguments)
    for place in [n for n, word in enumerate(words[:-1]) if word == "--plugin"][::-1]:
        words[place : place + 2] = [f"{_WORD}{words[place + 1]}"]
    words = [word.removeprefix("--") if word.startswith(f"--{_WORD}") else word for word in words]
    named = [word.removeprefix(_WORD) for word in plugin_words(words)] + [plugin] * bool(plugin)
    if not named:
        return words, None
    paths = {load_plugin(each) for each in named if each is not None}
    if len(paths) > 1:
        raise ValueError(f"plugin must be one file, got {' and '.join(sorted(paths))}")
    path = paths.pop()
    return [*(word for word in words if not word.startswith(_WORD)), f"{_WORD}{path}"], path


class OwnSignals:
    """Those signals of a run that its plugin registered.

    Args:
        names: Learned signals of the method.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._functions: dict[str, SignalFunction] = {}
        for name in names:
            if name in SIGNALS:
                signal = SIGNALS[name]
                self._functions[name] = signal() if isinstance(signal, type) else signal

    def __len__(self) -> int:
        return len(self._functions)

    def write(self, learner: Any, batch: TensorDictBase) -> None:
        """Write the signals in a batch, before the learner learns from it."""
        for name, function in self._functions.items():
            value: Tensor = function(learner, batch)
            if value.shape != batch.shape[:1]:
                raise ValueError(
                    f"signal {name!r} must have shape {[*batch.shape[:1]]}, got {[*value.shape]}"
                )
            batch["signals", name] = value.detach()

    def state_dict(self) -> dict[str, Any]:
        """Return the states of those that have one."""
        states = {name: each for name, each in self._functions.items() if _has_state(each)}
        return {name: each.state_dict() for name, each in states.items()}  # type: ignore[attr-defined]

    def load_state_dict(self, states: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        for name, state in states.items():
            self._functions[name].load_state_dict(state)  # type: ignore[attr-defined]


def _has_state(function: SignalFunction) -> bool:
    return hasattr(function, "state_dict") and hasattr(function, "load_state_dict")
