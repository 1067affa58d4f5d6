"""Buffers against a model of plain Python, under any sequence of calls."""

import shutil
import tempfile
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from tensordict import TensorDict

from tests.mpfa.transitions import make_buffer, same, snapshot, write_signals
from torchrl_mpfa import SignalMemmapStorage, SignalTensorStorage
from torchrl_mpfa.saving import load_safely, save_atomically

CAPACITY = 7


def make_rows(numbers):
    """Transitions whose every entry tells their number."""
    number = torch.tensor(numbers, dtype=torch.float32).unsqueeze(1)
    return TensorDict(
        {
            "observation": number.expand(-1, 3).contiguous(),
            "done": number.long() % 2 == 0,
            "next": {"reward": -number, "observation": number + 0.5},
        },
        [len(numbers)],
    )


class Replay(RuleBasedStateMachine):
    """A buffer, and beside it what plain Python says must be in it."""

    @initialize(memmap=st.booleans(), seed=st.integers(0, 9))
    def make(self, memmap, seed):
        self.folder = Path(tempfile.mkdtemp())
        self.memmap, self.seed, self.made = memmap, seed, 0
        self.buffer = self.new_buffer(seed)
        self.slots, self.signals = {}, {}
        self.cursor = self.next_number = 0

    def new_buffer(self, seed):
        self.made += 1
        if self.memmap:
            storage = SignalMemmapStorage(CAPACITY, scratch_dir=self.folder / f"data-{self.made}")
        else:
            storage = SignalTensorStorage(CAPACITY)
        return make_buffer(CAPACITY, storage=storage, seed=seed, entropy_refresh=0.5)

    def teardown(self):
        if hasattr(self, "folder"):
            shutil.rmtree(self.folder)

    def write(self, count):
        """Number the next transitions, and put them where a ring has them."""
        numbers = list(range(self.next_number, self.next_number + count))
        self.next_number += count
        expected = []
        for number in numbers:
            self.slots[self.cursor] = number
            self.signals.pop(self.cursor, None)
            expected.append(self.cursor)
            self.cursor = (self.cursor + 1) % CAPACITY
        return numbers, expected

    @rule(count=st.integers(0, 2 * CAPACITY + 1))
    def extend(self, count):
        numbers, expected = self.write(count)
        assert self.buffer.extend(make_rows(numbers)).tolist() == expected

    @rule()
    def add(self):
        numbers, expected = self.write(1)
        assert self.buffer.add(make_rows(numbers)[0]) == expected[0]

    @precondition(lambda self: self.slots)
    @rule(seed=st.integers(0, 99), late=st.integers(0, 3), size=st.integers(1, 4))
    def sample_and_update(self, seed, late, size):
        batch = self.buffer.sample()
        numbers = [self.slots[slot] for slot in batch["index"].tolist()]
        assert batch["observation"][:, 2].tolist() == numbers
        assert batch["next", "reward"][:, 0].tolist() == [-number for number in numbers]
        weight = batch["priority_weight"]
        assert bool(((weight > 0) & (weight <= 1 + 1e-6)).all())
        # Some slots may be overwritten between the sampling and the update.
        gone = set()
        if late:
            written, slots = self.write(late)
            self.buffer.extend(make_rows(written))
            gone = set(slots)
        batch = write_signals(batch[:size], seed=seed)
        self.buffer.update_tensordict_priority(batch)
        for slot, error in zip(
            batch["index"].tolist(), batch["signals", "td_error"].tolist(), strict=True
        ):
            if slot not in gone:
                self.signals[slot] = error

    @rule()
    def empty(self):
        self.buffer.empty()
        self.slots, self.signals, self.cursor = {}, {}, 0

    @rule(seed=st.integers(0, 9))
    def save_and_load(self, seed):
        save_atomically(self.buffer.state_dict(), self.folder / "state.pt")
        if not self.buffer.storage.initialized and self.memmap:
            return
        self.go_on_with(
            seed, lambda new: new.load_state_dict(load_safely(self.folder / "state.pt"))
        )

    @precondition(lambda self: self.slots)
    @rule(seed=st.integers(0, 9))
    def dump_and_load(self, seed):
        self.buffer.dumps(self.folder / "dump")
        self.go_on_with(seed, lambda new: new.loads(self.folder / "dump"))

    def go_on_with(self, seed, load):
        new = self.new_buffer(seed)
        if self.memmap and self.buffer.storage.initialized:
            new.extend(make_rows([0]))
        load(new)
        assert same(snapshot(self.buffer), snapshot(new))
        self.buffer = new

    @invariant()
    def the_buffer_holds_what_the_model_holds(self):
        if not hasattr(self, "buffer"):
            return
        assert len(self.buffer) == len(self.slots)
        if not self.slots:
            return
        table = self.buffer.storage.signal_table
        rows = self.buffer[:]
        for slot, number in self.slots.items():
            assert rows["observation"][slot].tolist() == [number] * 3
            assert rows["next", "observation"][slot] == number + 0.5
            assert bool(rows["done"][slot]) == (number % 2 == 0)
            assert table.rewards[slot] == -number
            error = table.rows[slot, table.column["td_error"]].item()
            assert error == self.signals[slot] if slot in self.signals else error != error


def drive(examples, steps, **kwargs):
    run_state_machine_as_test(
        Replay,
        settings=settings(
            max_examples=examples,
            stateful_step_count=steps,
            deadline=None,
            database=None,
            derandomize=True,
            suppress_health_check=list(HealthCheck),
            **kwargs,
        ),
    )


# TorchRL recommends a memory map that was allocated before.
@pytest.mark.filterwarnings("ignore:Loading the storage on an uninitialized TensorDict")
def test_buffer_equals_the_model_for_some_hundred_steps():
    drive(12, 30, phases=[Phase.generate])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Loading the storage on an uninitialized TensorDict")
def test_buffer_equals_the_model_for_ten_thousand_steps():
    drive(200, 50)
