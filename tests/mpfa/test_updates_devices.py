"""Updates whose batches, signals and learner are on different devices."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from tests.mpfa.second_device import DEVICE
from tests.mpfa.test_updates import BATCH, Counting, make_buffer, make_rows
from tests.mpfa.transitions import same
from torchrl_mpfa import run_updates


@pytest.mark.parametrize("updates", [1, 3])
@pytest.mark.parametrize(("home", "away"), [("cpu", DEVICE), (DEVICE, DEVICE), (DEVICE, "cpu")])
@pytest.mark.usefixtures("second_device")
def test_batches_go_to_the_device_of_the_learner_and_signals_come_back(updates, home, away):
    home, away = torch.device(home), torch.device(away)
    learner, buffer = Counting(), make_buffer(device=home)
    _, batch = run_updates(
        buffer,
        learner,
        updates=updates,
        prepare=lambda draw: replace(draw, batch=draw.batch.to(away)),
    )
    assert all(each.device == away for each in learner.batches)
    assert batch.device == home
    table = buffer.storage.signal_table
    assert table.rows.device == buffer.sampler.priorities().device == home
    assert bool((table.rows[batch["index"], table.column["td_error"]] == updates).all())


@pytest.mark.parametrize("updates", [1, 3])
def test_batches_of_another_device_come_back_to_that_of_their_rows(updates):
    # What has no device of its own stands for another one, which not every machine has.
    learner, buffer = Counting(), make_buffer()

    def prepare(draw):
        return replace(draw, batch=TensorDict(draw.batch.to_dict(), [len(draw.batch)]))

    _, batch = run_updates(buffer, learner, updates=updates, prepare=prepare)
    assert all(each.device is None for each in learner.batches)
    assert batch.device == torch.device("cpu")
    table = buffer.storage.signal_table
    assert bool((table.rows[batch["index"], table.column["td_error"]] == updates).all())


class Elsewhere(torch.Tensor):
    """Stands for a tensor on a GPU: cannot be computed with beside one of the CPU."""

    @classmethod
    def __torch_function__(cls, func, types, args=(), kwargs=None):
        here = [each for each in args if type(each) is torch.Tensor and each.ndim]
        # Copying goes across devices, and a mask of the CPU may select.
        if here and func.__name__ not in ("copy_", "__getitem__"):
            raise RuntimeError("expected all tensors to be on the same device")
        with torch._C.DisableTorchFunctionSubclass():
            found = func(*args, **(kwargs or {}))
        if func.__name__ == "to" or not isinstance(found, torch.Tensor):
            return found.as_subclass(torch.Tensor) if isinstance(found, torch.Tensor) else found
        return found.as_subclass(cls)


def test_batches_on_another_device_than_the_signals_update_them():
    ours, theirs = make_buffer(300), make_buffer(300)
    for buffer, kind in ((ours, Elsewhere), (theirs, torch.Tensor)):
        batch = buffer.sample()
        buffer.extend(make_rows(100))  # Some of the rows are overwritten before they come back.
        value = batch["action"].square().sum(-1).as_subclass(kind)
        stale = buffer.sampler.update_signals(
            batch["index"],
            {"td_error": value, "action_gradient": value},
            storage=buffer.storage,
            written_at=batch["written_at"].as_subclass(kind),
        )
        assert 0 < stale < BATCH
    assert same(ours.sampler.state_dict(), theirs.sampler.state_dict())
