"""Parts that two threads or two processes use at once are as those of one that does it in turn."""

import itertools
import multiprocessing
import sys
import threading

import pytest
import torch

from tests.mpfa.pairs.parts import BATCH, FUSING, make_rows
from tests.mpfa.pairs.test_all_pairs import covering
from tests.mpfa.pairs.twins import AXES, Twins, assert_same, fits, without_c

_PLAIN = {name: next(iter(values)) for name, values in AXES.items()}
_MET = ("sampler", "storage", "transform", "form")


def _choices(admits):
    """Choices of parts that meet, all else as it is at first, that some use admits."""
    axes = {name: [v for v in AXES[name] if admits(name, v)] for name in _MET}
    return [{**_PLAIN, **choice} for choice in covering(axes)]


def _spawned(name, value):
    # TorchRL shares no list, and a transform's memory stays in the process that writes, as the
    # priorities in the one that samples.
    return value not in {"list", "n steps", "hindsight", "torchrl", "uniform", "first priority"}


def _write(buffers, forms):
    """Write rows to all buffers, in another process."""
    for buffer, form in zip(buffers, forms, strict=True):
        for count, seed in ((5, 1), (30, 2)):  # Around the end.
            buffer.extend(make_rows(form, count, seed, 100 * seed).exclude("place"))


def test_rows_of_a_spawned_process_are_those_of_this_one(tmp_path):
    choices = _choices(_spawned)
    several = []
    for number, choice in enumerate(choices):
        twins = Twins(choice, tmp_path / str(number))
        twins.tried.share()
        twins.extend(21)
        twins.update()
        several.append(twins)
    forms = [choice["form"] for choice in choices]
    work = ([twins.tried for twins in several], forms)
    process = multiprocessing.get_context("spawn").Process(target=_write, args=work)
    process.start()
    process.join()
    assert process.exitcode == 0
    for twins, choice in zip(several, choices, strict=True):
        with without_c():
            _write([twins.twin], [choice["form"]])
        twins.reference = None
        twins.sample()  # Reads what was written, in both.
        twins.compare(("spawned", *choice.values()))
        twins.update()
        twins.extend(3)


@pytest.fixture
def often_switched():
    """Threads change places so often that a step without a lock is met."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


@pytest.mark.usefixtures("often_switched")
@pytest.mark.parametrize(
    "choice",
    _choices(lambda name, value: value not in {"torchrl", "uniform", "cer"}),
    ids=lambda choice: "-".join(choice[name] for name in _MET),
)
def test_threads_at_once_leave_rows_signals_and_leaves_whole(choice, tmp_path):
    twins = Twins(choice, tmp_path)
    buffer, errors = twins.tried, []
    source = torch.Generator("cpu").manual_seed(1)

    def extend(count, start):
        rows = make_rows(choice["form"], count, start, start)
        buffer.extend(rows if choice["transform"] == "hindsight" else rows.exclude("place"))

    def write():
        for start in range(42, 210, 14):
            extend(14, start)

    def learn():
        for _ in range(25):
            batch = buffer.sample(BATCH)
            signals = torch.rand(2, len(batch), generator=source, device="cpu")
            batch["signals", "td_error"], batch["signals", "action_gradient"] = signals.unbind()
            buffer.update_tensordict_priority(batch)

    def guarded(work):
        try:
            work()
        except Exception as error:
            errors.append(error)

    extend(42, 0)
    threads = [threading.Thread(target=guarded, args=(work,)) for work in (write, learn)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
    _check_whole(twins, choice)


def _check_whole(twins, choice):
    """Each row is of one write, the reward in the table is its own, and leaves are alike anew."""
    buffer = twins.tried
    if choice["storage"] != "list":
        rows = buffer.storage[:]
        assert (rows["observation"] == rows["observation"][:, :1]).all()
        if choice["transform"] == "none":
            assert rows["next", "observation"].equal(rows["observation"] + 1)
            key = twins.tried.sampler.table.reward_key
            assert buffer.rewards().equal(rows[key].reshape(-1).double())
    # A sampler that loads the state makes its trees from the leaves: no tree disagrees with them.
    fresh = twins.make()
    fresh.sampler.load_state_dict(buffer.sampler.state_dict())
    slots, size = torch.arange(len(buffer)), len(buffer)
    mine, anew = (part.sampler.trees for part in (buffer, fresh))
    assert_same(*(trees.leaves(slots) for trees in (mine, anew)), ("trees", "leaves"))
    for name in ("sum", "lowest"):
        values = [getattr(trees, name)(size) for trees in (mine, anew)]
        assert values[0] == pytest.approx(values[1], rel=1e-12)


def test_all_that_fuses_is_used_by_threads_and_a_process():
    spawned = {choice["sampler"] for choice in _choices(_spawned)}
    assert spawned == FUSING | {"cer"}
    pairs = itertools.product(FUSING, ("tensor", "memmap"))
    assert all(fits({**_PLAIN, "sampler": s, "storage": k}) for s, k in pairs)
