"""A buffer on the path that is tried, a twin without C, and what TorchRL itself stores."""

from contextlib import contextmanager

import torch
from tensordict import is_tensor_collection
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from tests.mpfa.pairs.parts import (
    BATCH,
    CAPACITY,
    CHANGED,
    CROSSED,
    FORMS,
    FUSING,
    MODES,
    NESTED_REWARD,
    ROUNDS,
    SAMPLERS,
    SAVED,
    SLICE,
    STORAGES,
    TRANSFORMS,
    make_rows,
)
from torchrl_mpfa import SignalReplayBuffer, native
from torchrl_mpfa.native import tables
from torchrl_mpfa.samplers import trees
from torchrl_mpfa.storages import plan

AXES = {
    "sampler": SAMPLERS,
    "storage": STORAGES,
    "transform": TRANSFORMS,
    "form": FORMS,
    "saved": SAVED,
    "mode": MODES,
    "rounds": ROUNDS,
    "changed": CHANGED,
}


COPIED = ("pickle", "deepcopy")


@contextmanager
def without_c():
    """Have parts take PyTorch in place of the compiled loops."""
    modules = (native, tables, trees, plan)
    before = [module.find_loops for module in modules]
    for module in modules:
        module.find_loops = lambda: None
    try:
        yield
    finally:
        for module, function in zip(modules, before, strict=True):
            module.find_loops = function


def fits(choice):
    """Return True if TorchRL or the package promises that these parts go together."""
    of = choice.get
    plain = of("sampler") is not None and of("sampler") not in FUSING
    by_c, listed = of("storage") in ("tensor", "memmap"), of("storage") == "list"
    rejected = (
        # Slices follow each other in the storage, and episodes in hindsight do not.
        of("sampler") == "reaper" and listed,
        of("sampler") in ("slices", "starts") and (listed or of("transform") == "hindsight"),
        # TorchRL's own storages ask for numbers on the default device, and trace otherwise.
        of("storage") is not None and not by_c and of("mode") in ("default device", "compiled"),
        plain and of("mode") in ("default device", "compiled"),
        # TensorDict copies no file without numbers; ours says so, in a test below.
        of("form") == "empty" and of("storage") == "torchrl memmap",
        of("form") == "empty" and of("storage") == "memmap" and of("saved") in COPIED,
        # It takes seconds to compile, which how a buffer is saved does not depend on.
        of("mode") == "compiled" and of("saved") not in (None, "not"),
        of("mode") == "compiled" and of("rounds") == "three batches",
        of("mode") == "compiled" and of("changed") not in (None, "nothing"),
        # TorchRL's checkpointers of trajectories save no list.
        listed and of("saved") in ("flat", "nested"),
        # TED asks for the entries of trajectories alone, in their order of writing.
        of("saved") in ("flat", "nested") and of("transform") in ("n steps", "hindsight"),
        of("saved") in ("flat", "nested") and of("form") in ("nested", "empty"),
        of("saved") in ("flat", "nested") and of("storage") in ("memmap", "torchrl memmap"),
        plain and of("changed") not in (None, "nothing", "alpha"),
        of("sampler") in ("cer", "uniform") and of("changed") == "alpha",
        plain and of("form") in ("nested", "first priority"),
        # TorchRL's n steps read the reward in one place.
        of("form") == "nested" and of("transform") == "n steps",
        # Episodes are told apart by a number that hindsight does not store.
        of("sampler") == "reaper" and of("transform") == "hindsight",
        of("sampler") in ("rank", "reaper") and of("changed") not in (None, "nothing", "level"),
    )
    return not any(value for value in rejected if value)


def raised(work):
    """Return the result of a call, or its error as a pair of texts."""
    try:
        return work()
    except Exception as error:
        return type(error).__name__, str(error)


def assert_same(left, right, place):
    """Both are equal: errors by their words, entries by their keys, weights as floats allow."""
    if isinstance(left, tuple) or isinstance(right, tuple):
        assert left == right, place
    elif is_tensor_collection(left):
        keys = [set(map(str, data.keys(True, True))) for data in (left, right)]
        assert keys[0] == keys[1], (place, keys[0] ^ keys[1])
        assert left.batch_size == right.batch_size, place
        for key in left.keys(True, True):
            assert_same(left[key], right[key], (*place, key))
    elif isinstance(left, Tensor):
        assert left.dtype is right.dtype and left.shape == right.shape, place
        exact = not left.is_floating_point() or place[-1] not in ("priority", "priority_weight")
        if exact:
            left, right = (v.nan_to_num(1e9) if v.is_floating_point() else v for v in (left, right))
            assert torch.equal(left, right), place
        else:
            torch.testing.assert_close(left, right, rtol=1e-6, atol=0.0, equal_nan=True)
    else:
        assert left == right, place


class Twins:
    """The buffer that is tried, its twin without C, and a buffer of TorchRL's with equal rows."""

    def __init__(self, choice, folder):
        self.choice, self.folder, self.made = choice, folder, 0
        self.compiled = set()
        self.tried, self.twin = self.make(), None
        with without_c():
            self.twin = self.make()
        self.reference = TensorDictReplayBuffer(storage=LazyTensorStorage(CAPACITY))
        if (transform := TRANSFORMS[choice["transform"]]()) is not None:
            self._seed(transform)
            self.reference.append_transform(transform)
        self.step = 0

    def make(self):
        """Make a buffer of the chosen parts."""
        self.made += 1
        folder = self.folder / f"rows-{self.made}"
        options = {}
        if self.choice["form"] == "nested" and self.choice["sampler"] in FUSING:
            options["reward_key"] = NESTED_REWARD
        buffer = SignalReplayBuffer(
            storage=STORAGES[self.choice["storage"]](folder),
            sampler=SAMPLERS[self.choice["sampler"]](**options),
            batch_size=BATCH,
            priority_key="first" if self.choice["form"] == "first priority" else "td_error",
            allow_nonfinite=["scan"],
            generator=torch.Generator("cpu").manual_seed(3),
        )
        if (transform := TRANSFORMS[self.choice["transform"]]()) is not None:
            self._seed(transform)
            buffer.append_transform(transform)
        return buffer

    @staticmethod
    def _seed(transform):
        if getattr(transform, "generator", None) is not None:
            transform.generator.manual_seed(5)

    def both(self, name, work):
        """Do the same with both buffers, the tried one in its mode; return both results."""
        mode = MODES[self.choice["mode"]]
        if self.choice["mode"] == "compiled":
            mode = MODES["plain"] if name in self.compiled else mode
            self.compiled.add(name)
        left = raised(lambda: mode(lambda: work(self.tried)))
        with without_c():
            right = raised(lambda: work(self.twin))
        assert_same(left, right, (name,))
        self.compare(name)
        return left

    def extend(self, count):
        """Write rows, which TorchRL stores alike."""
        seed, start = self.step, 1000 * (self.step // 1000) + self.step

        def rows():
            data = make_rows(self.choice["form"], count, seed, start)
            return data if self.choice["transform"] == "hindsight" else data.exclude("place")

        self.step += count
        data, again = rows(), rows()
        result = self.both("extend", lambda b: b.extend(data if b is self.tried else again))
        assert isinstance(result, Tensor), result
        if self.reference is not None and not isinstance(result, tuple):
            expected = rows()
            try:
                self.reference.extend(expected.exclude("first").contiguous())
            except (RuntimeError, NotImplementedError):
                self.reference = None  # What TorchRL cannot write.
            self.compare_with_torchrl("extend")
        return result

    def compare(self, name):
        """Compare all that the next batches depend on, and the rows with TorchRL's."""
        tried, twin = self.tried, self.twin
        place = (name, "after")
        assert len(tried) == len(twin), place
        assert tried.writer._cursor == twin.writer._cursor, place
        if hasattr(tried.sampler, "priorities"):
            values = tried.sampler.priorities(), twin.sampler.priorities()
            assert_same(*values, (*place, "priority"))
            assert tried.sampler.default_priority == twin.sampler.default_priority, place
            slots = torch.arange(CAPACITY, device="cpu")
            kept = [b.sampler.trees for b in (tried, twin)]
            assert_same(*(t.leaves(slots) for t in kept), (*place, "leaves", "priority"))
            assert_same(*(t.priorities for t in kept), (*place, "learned", "priority"))
        if hasattr(tried.sampler, "table"):
            assert_same(tried.sampler.table.rows, twin.sampler.table.rows, (*place, "table"))
            assert_same(tried.sampler.weights, twin.sampler.weights, (*place, "weights"))
        if len(tried) and self.choice["storage"] != "list":
            stored = (b.storage[:].exclude("index") for b in (tried, twin))
            assert_same(*stored, (*place, "rows"))

    def compare_with_torchrl(self, name):
        """Compare the stored rows with those of TorchRL's buffer."""
        if self.reference is not None and self.choice["storage"] != "list":
            stored = (b.storage[:].exclude("index") for b in (self.tried, self.reference))
            assert_same(*stored, (name, "TorchRL"))

    def sample(self, batches=1):
        """Sample, and compare rows by key with those that are stored."""
        batch = self.both("sample", lambda b: b.sample(BATCH * batches))
        if isinstance(batch, tuple) or self.reference is None:
            return batch
        expected = self.reference.storage.get(batch["index"])
        if self.choice["transform"] == "mirror":
            expected = expected.clone()
            expected["observation"] = -expected["observation"]
        written = {"index", "priority_weight", "written_at"}
        if self.choice["sampler"] in ("slices", "starts"):
            written |= {("next", "truncated"), ("next", "done")}
            last = torch.arange(len(batch)) % SLICE == SLICE - 1
            assert torch.equal(batch["next", "truncated"].squeeze(1), last)
            done = expected["next", "done"] | batch["next", "truncated"]
            assert torch.equal(batch["next", "done"], done)
        if self.choice["sampler"] in FUSING:
            keys = set(batch.keys(True, True))
            assert keys == set(expected.keys(True, True)) | written, keys ^ set(
                expected.keys(True, True)
            )
        for key in set(expected.keys(True, True)) - written:
            assert_same(batch[key], expected[key], ("sampled", key))
        return batch

    def update(self, stale=False):
        """Sample and update, of one or several batches, some of them overwritten meanwhile."""
        batches = ROUNDS[self.choice["rounds"]]
        seed = self.step + 7

        def work(buffer):
            source = torch.Generator("cpu").manual_seed(seed)
            batch = buffer.sample(BATCH * batches)
            count = len(batch)
            signals = torch.rand(2, count, generator=source, device="cpu")
            batch["signals", "td_error"], batch["signals", "action_gradient"] = signals.unbind()
            batch["td_error"] = signals[0]
            return batch

        sampled = [self.both("sample", work)]
        if isinstance(sampled[0], tuple):
            return
        # Each twin updates its own batch, which is equal to the other's.
        batch = sampled[0]
        if stale:
            self.extend(5)
        several = {"batches": batches} if self.choice["sampler"] in FUSING else {}
        self.both("update", lambda b: b.update_tensordict_priority(batch.clone(), **several))

    def save(self):
        """Save and load both; by most paths each loads what the other saved."""
        save, crossed = SAVED[self.choice["saved"]], self.choice["saved"] in CROSSED
        fresh = self.make()
        with without_c():
            fresh_twin = self.make()
        folders = [self.folder / f"{side}-{self.made}" for side in ("tried", "twin")]
        for folder in folders:
            folder.mkdir()
        if crossed:
            loaded = raised(lambda: save(self.twin, fresh, folders[0]))
            with without_c():
                loaded_twin = raised(lambda: save(self.tried, fresh_twin, folders[1]))
        else:
            loaded = raised(lambda: save(self.tried, fresh, folders[0]))
            with without_c():
                loaded_twin = raised(lambda: save(self.twin, fresh_twin, folders[1]))
        if isinstance(loaded, tuple) or isinstance(loaded_twin, tuple):
            raise AssertionError(("save", loaded, loaded_twin))
        self.tried, self.twin = loaded, loaded_twin
        if self.choice["saved"] in ("pickle", "deepcopy"):
            for buffer in (self.tried, self.twin):
                buffer.set_rng(torch.Generator("cpu").manual_seed(9))
        saved = self.choice["saved"] != "not"
        if saved and self.choice["transform"] in ("n steps", "hindsight"):
            # Steps that wait, and the choice of goals, are no part of TorchRL's states.
            self.reference = None
        self.compare("save")
        self.compare_with_torchrl("save")

    def reject(self):
        """Ask for a batch that cannot be sampled, which moves no generator."""
        if self.choice["sampler"] not in ("mpfa", "fixed"):
            return

        def spoil(buffer):
            buffer.sampler._eps, eps = 0.0, buffer.sampler._eps
            buffer.update_priority(torch.tensor([0], device="cpu"), 0.0)
            buffer.sampler._eps = eps

        self.both("spoil", spoil)
        error, text = self.both("rejected", lambda b: b.sample())
        assert error == "RuntimeError" and "every priority must be positive" in text
        self.both("mend", lambda b: b.update_priority(torch.tensor([0], device="cpu"), 1.0))

    def change(self):
        """Set what the choice names of both samplers."""
        work = CHANGED[self.choice["changed"]]
        work(self.tried.sampler)
        with without_c():
            work(self.twin.sampler)
        self.compare("change")
