"""Every pair of parts works as without C, as eagerly, and as TorchRL's buffer stores rows."""

import itertools
import random
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

from tests.mpfa.pairs.twins import AXES, COPIED, Twins, fits
from torchrl_mpfa import native

pytestmark = [
    pytest.mark.skipif(native.find_loops() is None, reason="there is no C compiler"),
    # TorchRL's checkpointers, of a buffer that was never written to.
    pytest.mark.filterwarnings("ignore:Loading the storage on an uninitialized TensorDict"),
]


def covering(axes, seed=0):
    """Choices in which each pair of values that fit comes at least once, found greedily."""
    source = random.Random(seed)
    names = list(axes)
    pairs = {
        frozenset(((one, a), (two, b)))
        for one, two in itertools.combinations(names, 2)
        for a in axes[one]
        for b in axes[two]
        if fits({one: a, two: b})
    }
    while pairs:
        choice = dict(source.choice(sorted(pairs, key=sorted)))
        for name in source.sample(names, len(names)):
            if name in choice:
                continue
            values = [value for value in axes[name] if fits({**choice, name: value})]
            gained = {
                value: sum(frozenset(((name, value), old)) in pairs for old in choice.items())
                for value in values
            }
            most = max(gained.values())
            choice[name] = source.choice([value for value in values if gained[value] == most])
        pairs -= {frozenset(pair) for pair in itertools.combinations(choice.items(), 2)}
        yield {name: choice[name] for name in names}


CHOICES = [*covering(AXES)]


@pytest.mark.parametrize("choice", CHOICES, ids=lambda choice: "-".join(choice.values()))
def test_parts_work_together_as_without_c_and_as_in_torchrl(choice, tmp_path):
    twins = Twins(choice, tmp_path)
    twins.extend(21)
    twins.sample()
    twins.update()
    twins.change()
    twins.update(stale=True)
    twins.extend(35)  # Around the end.
    twins.update()
    twins.save()
    twins.reject()
    twins.sample()
    twins.update(stale=True)
    twins.extend(1)
    twins.sample(2)


def test_every_value_of_every_axis_is_in_a_choice():
    for name, values in AXES.items():
        assert {choice[name] for choice in CHOICES} == set(values)


@pytest.mark.parametrize("saved", COPIED)
def test_an_entry_without_numbers_in_a_mapped_file_is_rejected_at_the_save(saved, tmp_path):
    plain = {name: next(iter(values)) for name, values in AXES.items()}
    twins = Twins({**plain, "storage": "memmap", "form": "empty", "saved": saved}, tmp_path)
    twins.extend(21)
    twins.extend(5)
    with pytest.raises(AssertionError, match="entries must have numbers to be copied, got shape"):
        twins.save()


@pytest.mark.parametrize("sampler", ["slices", "starts", "reaper"])
def test_a_list_is_rejected_by_what_looks_at_neighbours_of_a_row(sampler, tmp_path):
    plain = {name: next(iter(values)) for name, values in AXES.items()}
    with pytest.raises(TypeError, match="storage must hold tensors of all steps"):
        Twins({**plain, "sampler": sampler, "storage": "list"}, tmp_path)


class Walk(RuleBasedStateMachine):
    """Operations in any order, on parts that fit each other."""

    @initialize(choice=st.sampled_from([c for c in CHOICES if c["mode"] != "compiled"]))
    def begin(self, choice):
        self.folder = TemporaryDirectory()
        self.twins = Twins(choice, Path(self.folder.name))
        self.twins.extend(21)

    @rule(count=st.integers(1, 60))
    def extend(self, count):
        self.twins.extend(count)

    @rule(batches=st.integers(1, 3))
    def sample(self, batches):
        self.twins.sample(batches)

    @rule(stale=st.booleans())
    def update(self, stale):
        self.twins.update(stale)

    @rule()
    def change(self):
        self.twins.change()

    @rule()
    def save(self):
        self.twins.save()

    def teardown(self):
        if hasattr(self, "folder"):
            self.folder.cleanup()


TestWalk = Walk.TestCase
TestWalk.settings = settings(
    max_examples=15,
    stateful_step_count=8,
    deadline=None,
    derandomize=True,
    suppress_health_check=[*HealthCheck],
)
