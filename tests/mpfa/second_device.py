"""A device that is none: tensors in main memory that stand for those of a GPU.

They mix with tensors on the CPU as little as those of a GPU do, and what is moved between the two,
and what the host has to wait for, is counted. Where there is a GPU it takes their place.
"""

from collections import Counter

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map_only

from torchrl_mpfa import checks
from torchrl_mpfa.samplers import TreeSampler
from torchrl_mpfa.samplers.trees import MinLeaves, PlainTrees, SumLeaves

DEVICE = torch.device("cuda:0")
WAITS = (
    "_local_scalar_dense",
    "nonzero",
    "equal",
    "masked_select",
    "_unique2",
    "unique_consecutive",
)
"""Operations whose result the host needs to go on; a number of rows counts as one."""
MIXED = ("_to_copy", "copy_", "index", "index_put_", "_index_put_impl_")
"""Operations that take tensors of both devices."""


class _Distant(torch.Tensor):
    """A tensor of the device, and in ``held`` its numbers."""

    @staticmethod
    def __new__(cls, held):
        return torch.Tensor._make_wrapper_subclass(
            cls,
            held.size(),
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=DEVICE,
        )

    def __init__(self, held):
        self.held = held

    def __repr__(self):
        return f"_Distant({self.held!r})"

    def tolist(self):
        return self.cpu().tolist()

    def __deepcopy__(self, memo):
        return self.clone()

    @classmethod
    def __torch_dispatch__(cls, operation, types, args=(), kwargs=None):
        raise AssertionError(f"{operation} outside of SecondDevice")


class SecondDevice(TorchDispatchMode):
    """While it is entered, ``DEVICE`` exists.

    Attributes:
        waits: How often the host waited for the device, by operation.
        moves: Tensors that went to the device, and rows to the host, by operation.
    """

    _mode_key = torch._C._TorchDispatchModeKey.FAKE
    """With this one PyTorch does not look for a driver."""

    def __init__(self):
        super().__init__()
        torch._C._ensureCUDADeviceGuardSet()
        self.waits = Counter()
        self.moves = Counter()

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        tensors = []
        tree_map_only(torch.Tensor, tensors.append, (args, kwargs))
        distant = [each for each in tensors if isinstance(each, _Distant)]
        # A number may come from the host, as on a GPU.
        near = [each for each in tensors if not isinstance(each, _Distant) and each.ndim > 0]
        name = operation.name().removeprefix("aten::").split(".")[0]
        if distant and near and name not in MIXED:
            raise RuntimeError(f"{name}: tensors on two devices")
        wanted = kwargs.get("device")
        goes = bool(distant) if wanted is None else torch.device(wanted).type == DEVICE.type
        if wanted is not None:
            kwargs = {**kwargs, "device": "cpu"}
        if name == "copy_":
            goes = isinstance(args[0], _Distant)
        moved = name in ("_to_copy", "copy_")
        masked = name == "index" and any(each.dtype is torch.bool for each in tensors[1:])
        if distant and (name in WAITS or masked or (moved and not goes)):
            self.waits[name] += 1
        if near and goes and name in MIXED:
            self.moves[name] += 1
        held = tree_map_only(_Distant, lambda each: each.held, (args, kwargs))
        found = operation(*held[0], **held[1])
        if distant and args and args[0] is distant[0] and found is distant[0].held:
            return distant[0]  # In place.
        if name == "copy_":
            return args[0]
        return tree_map_only(torch.Tensor, _Distant, found) if goes else found


def emulated(monkeypatch):
    """A :class:`SecondDevice`, not yet entered."""
    made = checks.seeded_generator
    # There is no generator of a device that is none.
    monkeypatch.setattr(checks, "seeded_generator", lambda source=None, device="cpu": made(source))
    return SecondDevice()


def use_leaves(monkeypatch):
    """Let samplers on the CPU have what those of other devices have in place of trees."""
    made = TreeSampler._init

    def init(self):
        made(self)
        self.trees = make_leaves(self._max_capacity)

    monkeypatch.setattr(TreeSampler, "_init", init)


def make_leaves(capacity):
    """Trees on the CPU as another device has them."""
    trees = PlainTrees(capacity, torch.device("cpu"))
    trees.waits = True
    trees._sums = SumLeaves(capacity, torch.device("cpu"))
    trees._lows, trees._highs = (MinLeaves(capacity, torch.device("cpu")) for _ in range(2))
    return trees
