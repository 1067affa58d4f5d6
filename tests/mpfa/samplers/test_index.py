"""The index of a batch in all its forms: read, or rejected by name before anything changes."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import ReplayBufferEnsemble

from tests.mpfa.transitions import make_filled, make_transitions, write_signals
from torchrl_mpfa.samplers.slots import as_slots

pytestmark = pytest.mark.usefixtures("path")

NO_INTEGERS = "index must hold integers, got"


def nested(slots):
    """An index as parts of an ensemble's batch have it."""
    slots = torch.as_tensor(slots)
    return TensorDict({"index": slots, "buffer_ids": torch.zeros_like(slots)}, slots.shape[:1])


@pytest.mark.parametrize(
    "index", [[], torch.empty(0), torch.empty(0, dtype=torch.bool), torch.empty(0, 2).long()]
)
def test_an_index_of_nothing_is_no_slot_in_any_form(index):
    slots = as_slots(index)
    assert slots.dtype is torch.long
    assert slots.shape == (0,)


def test_part_of_an_ensembles_batch_updates_the_priorities_of_its_rows():
    parts = [make_filled(seed=seed) for seed in (0, 1)]
    ensemble = ReplayBufferEnsemble(*parts, sample_from_all=True, batch_size=8)
    for buffer, batch in zip(parts, ensemble.sample().unbind(0), strict=True):
        slots, before = batch["index", "index"], buffer.sampler.priorities()
        buffer.update_tensordict_priority(write_signals(batch))
        changed = (buffer.sampler.priorities() != before).nonzero().squeeze(1)
        assert changed.tolist() == slots.unique().tolist()


def test_every_method_reads_the_index_in_a_tensordict():
    buffer, slots = make_filled(), [2, 5]
    buffer.update_priority(nested(slots), torch.tensor([3.0, 4.0]))
    expected = buffer.sampler.priorities(torch.tensor(slots))
    assert buffer.sampler.priorities(nested(slots)).tolist() == expected.tolist()
    assert buffer.storage.get(nested(slots))["observation"].flatten().tolist() == slots
    buffer.mark_update(nested(slots))
    highest = buffer.sampler.priorities().max()
    assert buffer.sampler.priorities(nested(slots)).tolist() == [highest] * 2
    buffer.storage.set(
        nested(slots), make_transitions(2, first=50).set("index", torch.tensor(slots))
    )
    assert buffer.storage.get(slots)["observation"].flatten().tolist() == [50.0, 51.0]
    assert buffer.storage.signal_table.written_at(torch.tensor(slots)).tolist() == [16.0, 17.0]


WRONG = {
    "tensordict without an index": TensorDict({"slot": torch.arange(2)}, [2]),
    "list of tensordicts": [nested([0, 1])],
    "None": None,
    "text": "ab",
    "mapping": {},
    "mask": torch.ones(2, dtype=torch.bool),
    "mask of NumPy": np.array([True, False]),
    "floats": torch.tensor([0.5, 1.0]),
    "numbers of floats in a tuple": (torch.tensor([0.5]), torch.tensor([1.0])),
    "tensordicts in a tuple": (TensorDict({}, [2]), TensorDict({}, [2])),
}
METHODS = {
    "update_priority": lambda buffer, index: buffer.update_priority(index, torch.ones(2)),
    "mark_update": lambda buffer, index: buffer.mark_update(index),
    "update_signals": lambda buffer, index: buffer.sampler.update_signals(
        index,
        {"td_error": torch.ones(2), "action_gradient": torch.ones(2)},
        storage=buffer.storage,
    ),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("wrong", WRONG)
def test_index_without_integers_is_rejected_by_name_and_changes_nothing(method, wrong):
    buffer = make_filled()
    before = buffer.sampler.priorities()
    with pytest.raises(TypeError, match=NO_INTEGERS):
        METHODS[method](buffer, WRONG[wrong])
    assert torch.equal(buffer.sampler.priorities(), before)


@pytest.mark.parametrize("method", ["get", "set"])
def test_storage_rejects_a_tensordict_without_an_index_and_changes_nothing(method):
    storage = make_filled().storage
    arguments = (make_transitions(2),) if method == "set" else ()
    with pytest.raises(TypeError, match=NO_INTEGERS):
        getattr(storage, method)(WRONG["tensordict without an index"], *arguments)
    assert storage.signal_table.writes == 16
