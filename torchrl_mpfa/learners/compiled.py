"""An update as one compiled program, recorded from the eager one.

With networks of a hundred units an update is mostly the cost of calling some five hundred small
operations, of which ``torch.compile`` makes one. They are recorded while the update runs once, so
that nothing is said a second time, and a loss or network of a user is in the program, too.
Learners whose losses record the same operations share one compiled program, as all tensors of a
loss are inputs of it: a learner of the same settings as one before it is only recorded.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from itertools import islice
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase, is_non_tensor, is_tensor_collection
from tensordict.utils import NestedKey
from torch import Tensor, fx
from torch._inductor import config
from torch._inductor.runtime.cache_dir_utils import default_cache_dir
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.fx.experimental.proxy_tensor import make_fx
from torch.fx.experimental.symbolic_shapes import ShapeEnv

from torchrl_mpfa.caches import own_cache_folder
from torchrl_mpfa.learners.adam import FlatAdam, FlatGroup
from torchrl_mpfa.selection import Trains
from torchrl_mpfa.signals import SIGNALS_KEY

Entries = dict[NestedKey, Tensor]
Call = Callable[..., list[Tensor]]

_COMPILED: dict[Any, Call] = {}
"""Programs of the learners of this process, by all that they depend on."""


class Program(NamedTuple):
    """An update, for batches of one form."""

    call: Call
    """From the entries of a batch and ``state`` to gradients, signals, and values for the log."""
    state: list[Tensor]
    """Tensors of the learner, and those that its loss keeps; they are changed in place."""
    stepped: list[FlatGroup] | None
    """Groups of parameters that the program moves; None if it gives their gradients instead."""
    moved: list[Tensor]
    """Parameters that the gradients belong to."""
    written: list[NestedKey]
    """Entries that the loss writes in a batch."""
    log: list[str]
    """Names of the values for the log."""


class Step(NamedTuple):
    """What an update has done."""

    log: dict[str, Tensor]
    taken: bool
    """True if the steps were taken, which they are not if a loss is not finite, or if they are left
    to the learner."""


class CompiledUpdate:
    """Makes the updates of a learner by a program, one for each form of a batch.

    The program takes the steps of Adam and of the target networks as well. Steps of another
    optimizer, of one with hooks, and of groups of which only a part has gradients are left to the
    learner: the program then gives gradients. A warning says so, once, or that there is no program.
    """

    def __init__(self, learner: Any, compile: dict[str, Any]) -> None:
        _keep_programs()
        self._learner = learner
        self._arguments = compile
        self._programs: dict[Any, Program | None] = {}
        self._warned = False
        self._device = next(learner.networks.parameters()).device.type

    def __getstate__(self) -> dict[str, Any]:
        # A copy has other tensors, and a program cannot be pickled.
        return {**vars(self), "_programs": {}}

    def __call__(
        self, batch: TensorDictBase, trains: Trains, loss_function: str | None
    ) -> Step | None:
        """Make an update and write signals in the batch; None if it cannot be recorded."""
        entries = self._entries(batch)
        program = self._program_for(entries, batch.batch_size[:1], trains, loss_function)
        if program is None:
            return None
        step, signals = self._run(program, entries.values())
        for key, value in zip(program.written, signals, strict=True):
            _write(batch, key, value)
        return step

    def each(
        self, rows: TensorDictBase, batch_size: int, turns: Sequence[Trains]
    ) -> Iterator[Step] | None:
        """Make an update with each batch of rows ``[U * B]``, and write all signals at last.

        None, before anything is done, if one of the updates cannot be recorded.
        """
        # A TensorDict is not made of each batch, which would take as long as an update by Adam.
        columns = {key: value.split(batch_size) for key, value in self._entries(rows).items()}
        first = {key: parts[0] for key, parts in columns.items()}
        size = torch.Size([batch_size])
        programs = {turn: self._program_for(first, size, turn, None) for turn in set(turns)}
        if None in programs.values():
            return None
        return self._runs(rows, columns, [programs[turn] for turn in turns])

    def _runs(
        self, rows: TensorDictBase, columns: dict[NestedKey, Any], programs: list[Any]
    ) -> Iterator[Step]:
        """Run one program after the other; write all signals at last."""
        written: dict[NestedKey, list[Tensor]] = {}
        for program, *values in zip(programs, *columns.values(), strict=True):
            step, signals = self._run(program, values)
            for key, value in zip(program.written, signals, strict=True):
                written.setdefault(key, []).append(value)
            yield step
        for key, parts in written.items():
            _write(rows, key, torch.cat(parts))

    def _entries(self, batch: TensorDictBase) -> Entries:
        """Return what a program may read, each tensor in the one layout that programs are for."""
        written = {"td_error", *((SIGNALS_KEY, name) for name in self._learner.signals)}
        return {k: v.contiguous() for k, v in _leaves(batch) if k not in written}

    def _program_for(
        self, entries: Entries, size: torch.Size, trains: Trains, loss_function: str | None
    ) -> Program | None:
        """Return the program for batches of this form, made at the first of them."""
        precision = torch.is_autocast_enabled(self._device) and torch.get_autocast_dtype(
            self._device
        )
        steps = _records_steps(self._learner.optimizer)
        options = _options(self._learner)
        form = trains, loss_function, precision, steps, options, *map(_form, entries.items())
        if form not in self._programs:
            self._programs[form] = self._make(entries, size, trains, loss_function, steps)
        return self._programs[form]

    def _run(self, program: Program, values: Iterable[Tensor]) -> tuple[Step, list[Tensor]]:
        """Make an update by a program; return the signals as well."""
        for group in program.stepped or ():
            group.scale()
        with torch.no_grad():
            outputs = iter(program.call(*values, *program.state))
        for parameter in program.moved:
            parameter.grad = next(outputs)
        signals = list(islice(outputs, len(program.written)))
        log = dict(zip(program.log, outputs, strict=False))
        if program.stepped is None or not next(outputs).item():
            return Step(log, False), signals
        for group in program.stepped:
            group.count_step(self._learner.optimizer.state)
        return Step(log, True), signals

    def forget(self) -> None:
        """Have programs made again: the tensors of the learner lie elsewhere now."""
        self._programs.clear()

    def _make(
        self,
        entries: Entries,
        batch_size: torch.Size,
        trains: Trains,
        loss_function: str | None,
        steps: bool,
    ) -> Program | None:
        learner = self._learner
        optimizer, stepped = learner.optimizer, None
        learner.optimizer.zero_grad()
        parameters = [value for value in learner.networks.parameters() if value.requires_grad]
        parts = learner.networks, learner.targets
        tensors = [v for part in parts for v in (*part.parameters(), *part.buffers())]
        if steps:
            tensors += [tensor for group in optimizer.flat_groups for tensor in group.tensors()]
        moved: list[Tensor] = []
        written: Entries = {}
        log: dict[str, Tensor] = {}

        def update(*values: Tensor) -> list[Tensor]:
            nonlocal stepped
            batch = TensorDict(dict(zip(entries, values, strict=True)), batch_size)
            with torch.enable_grad():
                log.update(learner._differentiate(batch, trains, loss_function))
            written.update((k, v) for k, v in batch.items(True, True) if k not in entries)
            outputs = [*written.values(), *(value.detach() for value in log.values())]
            if steps:
                stepped = optimizer.due_groups()
            if stepped is None:
                moved.extend(p for p in parameters if p.grad is not None)
                return [*(p.grad for p in moved), *outputs]  # type: ignore[list-item]
            losses = [value for name, value in log.items() if name.startswith("loss")]
            finite = torch.stack([loss.detach().isfinite().all() for loss in losses]).all()
            with torch.no_grad():
                for group in stepped:
                    group.record_step(finite)
                if trains != "critic":
                    learner.record_targets(finite)
            return [*outputs, finite]

        # Recorded with real numbers, as a loss may make tensors that it keeps; but with none of the
        # random numbers that the update will have.
        devices = {value.device for value in entries.values() if value.is_cuda}
        before = [value.detach().clone() for value in tensors]
        try:
            with torch.random.fork_rng(devices):
                graph_module = make_fx(update)(*entries.values())
        except RuntimeError as error:
            if "data-dependent" not in str(error):
                raise
            self._warn(
                f"updates are not compiled: operations of the {type(learner).__name__} depend on "
                f"the numbers in a batch ({error})"
            )
            return None
        finally:
            # The steps were taken, and layers with running statistics have counted the batch.
            with torch.no_grad():
                for tensor, numbers in zip(tensors, before, strict=True):
                    tensor.copy_(numbers)
            learner.optimizer.zero_grad()
        if stepped is None:
            self._warn(
                f"steps of the {type(optimizer).__name__} are not compiled: a program takes those "
                "of an Adam without hooks, if all parameters of a group have gradients"
            )
        state = _take_state(graph_module, tensors)
        call = self._compiled(graph_module.graph, [*entries.values(), *state])
        return Program(call, state, stepped, moved, list(written), list(log))

    def _warn(self, text: str) -> None:
        """Say once that something falls back to PyTorch's own operations."""
        if not self._warned:
            self._warned = True
            warnings.warn(text, UserWarning, stacklevel=2)

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
    # Inductor's compiler itself: the layers of ``torch.compile`` around it would record once more,
    # three seconds at the start, and would take a tenth of an update.
    # Imported here, as it takes a second and many learners are not compiled.
    from torch._inductor.compile_fx import compile_fx_inner
    from torch._inductor.cpu_vec_isa import valid_vec_isa_list
    from torch._inductor.decomposition import select_decomp_table

    # With an environment of shapes, as Inductor's cache of graphs asks for one.
    mode = FakeTensorMode(shape_env=ShapeEnv())
    on_cpu = all(value.device.type == "cpu" for value in inputs)
    # Random numbers are those that the losses would have.
    patches = {"fallback_random": True, "cpp_wrapper": on_cpu, **arguments.get("options", {})}
    context = torch._guards.TracingContext(mode)

    def compiled(patches: dict[str, Any]) -> Any:
        with torch.no_grad(), config.patch(patches), torch._guards.tracing(context):
            fakes = [mode.from_tensor(value.detach(), static_shapes=True) for value in inputs]
            functional = torch.func.functionalize(lambda *values: module(*values))
            with mode:
                graph = make_fx(functional, decomposition_table=select_decomp_table())(*fakes)
            made: Any = compile_fx_inner(graph, fakes, cpp_wrapper=config.cpp_wrapper)
            return made.current_callable

    # To try each vector instruction set of the processor takes longer than to compile a program. An
    # old compiler may not have the newest of them: they are tried if it fails.
    untried = on_cpu and config.cpp.vec_isa_ok is None and "cpp.vec_isa_ok" not in patches
    try:
        call = compiled({**patches, "cpp.vec_isa_ok": True} if untried else patches)
    except Exception:
        if not untried:
            raise
        call = compiled(patches)
    finally:
        # Others may want them tried.
        valid_vec_isa_list.cache_clear()
    return lambda *values: call([*values])


def _keep_programs() -> None:
    """Have PyTorch keep programs in a folder of the user, unless the environment names one."""
    # Its own default is a temporary folder, where others may put something: a program is code.
    # PyTorch writes that default into the environment itself.
    if os.environ.get("TORCHINDUCTOR_CACHE_DIR") not in (None, default_cache_dir()):
        return
    # Processors of several kinds may share the folder.
    able = sorted(name for name, has in torch.cpu.get_capabilities().items() if has is True)
    processor = hashlib.sha256(repr(able).encode()).hexdigest()[:16]
    if (folder := own_cache_folder("programs", processor)) is None:
        folder = _folder_of_this_process()
    os.environ["TORCHINDUCTOR_CACHE_DIR"] = str(folder)


@cache
def _folder_of_this_process() -> Path:
    """Make a folder for programs that is removed when the process ends."""
    warnings.warn(
        "programs are compiled at every start, as there is no folder of caches that is yours and "
        "that only you can write to: set XDG_CACHE_HOME or TORCHINDUCTOR_CACHE_DIR",
        stacklevel=2,
    )
    folder = mkdtemp(prefix="torchrl_mpfa-")
    atexit.register(rmtree, folder, ignore_errors=True)
    return Path(folder)


def _leaves(batch: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[NestedKey, Tensor]]:
    """Iterate over the tensors of a batch, in half of the time of its own iterator."""
    for key, value in batch.items():
        if isinstance(value, Tensor):
            yield (*path, key) if path else key, value
        elif is_tensor_collection(value) and not is_non_tensor(value):
            yield from _leaves(value, (*path, key))


def _write(batch: TensorDictBase, key: NestedKey, value: Tensor) -> None:
    """Write a signal, found to fit when the update was recorded: checks take half of a write."""
    path = (key,) if isinstance(key, str) else key
    batch._set_tuple(path, value, inplace=False, validated=True, non_blocking=False)


def _form(entry: tuple[NestedKey, Tensor]) -> tuple[Any, ...]:
    key, value = entry
    return key, value.shape, value.dtype, value.device


def _options(learner: Any) -> tuple[Any, ...]:
    """Return the constants of a record: what of a learner is no tensor, and does not count."""
    plain = (bool, int, float, str, tuple)
    return tuple(v for k, v in vars(learner).items() if isinstance(v, plain) and k != "updates")


def _records_steps(optimizer: Any) -> bool:
    """Return True if the steps of an optimizer are in a program: Adam's, if nobody looks on."""
    if not isinstance(optimizer, FlatAdam) or not optimizer.is_flat():
        return False
    return not (optimizer._optimizer_step_pre_hooks or optimizer._optimizer_step_post_hooks)


def _take_state(trace: fx.GraphModule, tensors: list[Tensor]) -> list[Tensor]:
    """Make the tensors that a trace holds its last inputs, and return them."""
    graph, inputs = trace.graph, dict[int, tuple[fx.Node, Tensor]]()
    # The last of those that lie in one place is what the others are views of.
    of_storage = {_place(value): value for value in tensors}
    last = graph.find_nodes(op="placeholder")[-1]
    for node in graph.find_nodes(op="get_attr"):
        value = getattr(trace, node.target)
        place = _place(value)
        if place not in inputs:
            with graph.inserting_after(last):
                last = graph.placeholder(f"state_{len(inputs)}")
            # What is no tensor of the learner was made by its loss for the trace, or is kept by it.
            inputs[place] = last, of_storage.get(place, value)
        input_node, tensor = inputs[place]
        if _view(value) != _view(tensor):
            with graph.inserting_before(node):
                source = input_node, *_view(value)
                input_node = graph.call_function(torch.ops.aten.as_strided.default, source)
        node.replace_all_uses_with(input_node)
        graph.erase_node(node)
    for node in graph.nodes:
        # With what was noted of some inputs only, Inductor's C++ wrapper would miss the others.
        node.meta.clear()
    return [value for _, value in inputs.values()]


def _view(value: Tensor) -> tuple[torch.Size, tuple[int, ...], int]:
    return value.shape, value.stride(), int(value.storage_offset())


def _place(value: Tensor) -> int:
    """Return the address of a tensor's numbers; a tensor without numbers has its own."""
    return value.untyped_storage().data_ptr() or -id(value)
