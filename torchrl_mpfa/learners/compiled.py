"""Gradients and signals of an update as one compiled program, traced from the losses themselves.

With networks of a hundred units an update is mostly the cost of calling some five hundred small
operations, of which ``torch.compile`` makes one. They are recorded while the losses run once, so
that nothing is said a second time, and a loss or network of a user is in the program, too.
Learners whose losses record the same operations share one compiled program, as all tensors of a
loss are inputs of it: a learner of the same settings as one before it is only recorded.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from operator import is_
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, fx
from torch._inductor import standalone_compile
from torch._inductor.runtime.cache_dir_utils import default_cache_dir
from torch.fx.experimental.proxy_tensor import make_fx

from torchrl_mpfa.selection import Trains

Entries = dict[NestedKey, Tensor]
Call = Callable[..., list[Tensor]]

_COMPILED: dict[Any, Call] = {}
"""Programs of the learners of this process, by all that they depend on."""


class Program(NamedTuple):
    """Losses with their gradients, for batches of one form."""

    call: Call
    """From the entries of a batch and ``state`` to gradients, signals, and values for the log."""
    state: list[Tensor]
    """Tensors of the loss, and those that it keeps; later updates change them in place."""
    moved: list[Tensor]
    """Parameters that the gradients belong to."""
    written: list[NestedKey]
    """Entries that the loss writes in a batch."""
    log: list[str]
    """Names of the values for the log."""


class CompiledGradients:
    """Differentiates the losses of an update by a program, one for each form of a batch."""

    def __init__(self, loss: Any, compile: dict[str, Any]) -> None:
        _keep_programs()
        self._loss = loss
        self._arguments = compile
        self._programs: dict[Any, Program] = {}
        self._device = next(loss.parameters()).device.type
        self._held: list[Any] = []
        self._options: tuple[Any, ...] = ()

    def __call__(
        self, batch: TensorDictBase, trains: Trains, loss_function: str | None
    ) -> dict[str, Tensor]:
        """Set gradients and write signals like losses and a backward pass; return the log."""
        entries = self._entries(batch)
        self._read_options()
        precision = torch.is_autocast_enabled(self._device) and torch.get_autocast_dtype(
            self._device
        )
        form = trains, loss_function, precision, self._options, *map(_form, entries.items())
        program = self._programs.get(form)
        if program is None:
            made = self._make(entries, batch.batch_size[:1], trains, loss_function)
            program = self._programs[form] = made
        with torch.no_grad():
            found = iter(program.call(*entries.values(), *program.state))
        for parameter in program.moved:
            parameter.grad = next(found)
        for key in program.written:
            batch.set(key, next(found))
        return dict(zip(program.log, found, strict=True))

    def _entries(self, batch: TensorDictBase) -> Entries:
        """Return the tensors that a program may read: all but those that the loss writes."""
        keys = self._loss.tensor_keys
        written = {keys.priority, keys.td_error_signal, keys.action_gradient_signal}
        written |= {keys.value_signal, keys.information_gain_signal}
        found = batch.items(True, True)
        # A program is for one layout, which a slice of another tensor has not.
        return {k: v.contiguous() for k, v in found if isinstance(v, Tensor) and k not in written}

    def _read_options(self) -> None:
        """Read the constants of a trace again if one may have changed: options, keys, estimator."""
        loss, estimator = self._loss, self._loss.value_estimator
        parts = loss, estimator, loss.tensor_keys, estimator.tensor_keys
        held = [estimator, *estimator._buffers.values()]
        for part in parts:
            held += vars(part).values()
        if len(held) == len(self._held) and all(map(is_, held, self._held)):
            return
        self._held = held
        plain = [value for value in held if isinstance(value, (bool, int, float, str, tuple))]
        self._options = estimator, *map(id, estimator.buffers()), *plain

    def _make(
        self,
        entries: Entries,
        batch_size: torch.Size,
        trains: Trains,
        loss_function: str | None,
    ) -> Program:
        loss = self._loss
        # Views of parameters that lie elsewhere now are taken again, and before a trace, which
        # cannot hold that modules are copied.
        loss.forget_networks()
        loss._networks()
        state = {**dict(loss.named_parameters()), **dict(loss.named_buffers())}
        parameters = [value for value in state.values() if value.requires_grad]
        moved: list[Tensor] = []
        written: Entries = {}
        log: dict[str, Tensor] = {}

        def differentiate(*values: Tensor) -> list[Tensor]:
            batch = TensorDict(dict(zip(entries, values, strict=True)), batch_size)
            with torch.enable_grad():
                losses, more = loss.losses(
                    batch, trains=trains, loss_function=loss_function, defer_gradient=False
                )
                roots = [value for value in losses.values() if value.requires_grad]
                gradients = torch.autograd.grad(roots, parameters, allow_unused=True)
            moved.extend(p for p, g in zip(parameters, gradients, strict=True) if g is not None)
            written.update((k, v) for k, v in batch.items(True, True) if k not in entries)
            log.update({**losses, **more})
            of_log = [value.detach() for value in log.values()]
            return [*(each for each in gradients if each is not None), *written.values(), *of_log]

        # Recorded with real numbers, as a loss may make tensors that it keeps; but with none of the
        # random numbers that the update will have.
        devices = {value.device for value in entries.values() if value.is_cuda}
        buffers = [(value, value.clone()) for value in loss.buffers()]
        try:
            with torch.random.fork_rng(devices):
                graph_module = make_fx(differentiate)(*entries.values())
        except RuntimeError as error:
            if "data-dependent" not in str(error):
                raise
            raise ValueError(
                "compile needs a loss whose operations do not depend on the numbers in a batch, "
                f"got a {type(loss).__name__} where they do: {error}"
            ) from error
        finally:
            # Layers with running statistics have counted the batch of the trace.
            for value, before in buffers:
                value.copy_(before)
        taken = _take_state(graph_module, state)
        call = self._compiled(graph_module.graph, [*entries.values(), *taken])
        return Program(call, taken, moved, list(written), list(log))

    def _compiled(self, graph: fx.Graph, inputs: list[Any]) -> Call:
        """Compile a graph, or return the program of an equal graph with equal inputs."""
        # Operations are compared as objects; numbers and names of nodes as they are written.
        nodes = tuple((n.name, n.op, n.target, repr((n.args, n.kwargs))) for n in graph.nodes)
        forms = tuple((v.shape, v.stride(), v.dtype, v.device, v.requires_grad) for v in inputs)
        # The number of threads is in what is compiled.
        key = nodes, forms, torch.get_num_threads(), repr(self._arguments)
        if key not in _COMPILED:
            # A module without what was recorded with it.
            module = fx.GraphModule(torch.nn.Module(), graph)
            _COMPILED[key] = _compile(module, inputs, self._arguments)
        return _COMPILED[key]


def _compile(module: fx.GraphModule, inputs: list[Any], arguments: dict[str, Any]) -> Call:
    """Compile a record by Inductor itself, unless ``torch.compile`` has another backend."""
    if arguments.keys() - {"options"}:
        return torch.compile(module, **{"fullgraph": True, "dynamic": False, **arguments})
    # ``torch.compile`` would record it once more, three seconds at the start, and would compare the
    # inputs in each call, a third of an update. With gradients enabled there would be a second half
    # of the program, for the gradients of the gradients.
    with torch.no_grad():
        return standalone_compile(
            module,
            inputs,
            dynamic_shapes="from_example_inputs",
            # The random numbers that the losses would have.
            options={"config_patches": {"fallback_random": True, **arguments.get("options", {})}},
            donate_graph_module=True,
        )


def _keep_programs() -> None:
    """Have PyTorch keep programs in a folder of the user, unless the environment names one."""
    # Its own default is a temporary folder, where others may put something: a program is code.
    # PyTorch writes that default into the environment itself.
    if os.environ.get("TORCHINDUCTOR_CACHE_DIR") not in (None, default_cache_dir()):
        return
    kept = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    # Processors of several kinds may share the folder.
    able = sorted(name for name, has in torch.cpu.get_capabilities().items() if has is True)
    processor = hashlib.sha256(repr(able).encode()).hexdigest()[:16]
    folder = Path(kept, "torchrl_mpfa", "programs", processor)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # There is no home to write to: the temporary folder is what is left.
        return
    try:
        folder.chmod(0o700)
    except OSError as error:
        raise PermissionError(
            f"{folder} must be a folder of your own: set XDG_CACHE_HOME or TORCHINDUCTOR_CACHE_DIR"
        ) from error
    os.environ["TORCHINDUCTOR_CACHE_DIR"] = str(folder)


def _form(entry: tuple[NestedKey, Tensor]) -> tuple[Any, ...]:
    key, value = entry
    return key, value.shape, value.dtype, value.device


def _take_state(trace: fx.GraphModule, state: dict[str, Tensor]) -> list[Tensor]:
    """Make the tensors that a trace holds its last inputs, and return them."""
    graph, inputs = trace.graph, dict[int, tuple[fx.Node, Tensor]]()
    of_storage = {_place(value): value for value in state.values()}
    last = graph.find_nodes(op="placeholder")[-1]
    for node in graph.find_nodes(op="get_attr"):
        value = getattr(trace, node.target)
        place = _place(value)
        if place not in inputs:
            with graph.inserting_after(last):
                last = graph.placeholder(f"state_{len(inputs)}")
            # What is no tensor of the loss was made by it for the trace, or is kept by it.
            inputs[place] = last, of_storage.get(place, value)
        view = value.shape, value.stride(), value.storage_offset()
        with graph.inserting_before(node):
            source = inputs[place][0], *view
            taken = graph.call_function(torch.ops.aten.as_strided.default, source)
        node.replace_all_uses_with(taken)
        graph.erase_node(node)
    return [value for _, value in inputs.values()]


def _place(value: Tensor) -> int:
    """Return the address of a tensor's numbers; a tensor without numbers has its own."""
    return value.untyped_storage().data_ptr() or -id(value)
