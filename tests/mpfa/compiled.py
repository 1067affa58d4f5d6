"""Pairs of learners, eager and compiled, and what their tests share."""

import torch

from tests.mpfa.learning import make_batch, make_learner
from torchrl_mpfa.selection import SampledBatch

UNTRACED = {"disable": True}
"""The function itself, where tracing takes most of the time."""


def make_pair(name, compile=UNTRACED, **options):
    """An eager learner and a compiled one, with networks of the same weights."""
    return [make_learner(name, compile=each, **options) for each in (False, compile)]


def update_both(learners, seed, **given):
    """One update each by the same batch; their values for the log and their batches."""
    logs, batches = [], []
    for learner in learners:
        torch.manual_seed(seed)  # TD3 has noise in its targets.
        batches.append(make_batch(seed=seed, weighted=True))
        logs.append(learner.update(SampledBatch(batches[-1], **given)))
    return logs, batches


def tensors_of(state, name="state"):
    """All that a state holds, by where it lies."""
    if isinstance(state, dict):
        return {k: v for key in state for k, v in tensors_of(state[key], f"{name}.{key}").items()}
    if isinstance(state, list):
        return tensors_of(dict(enumerate(state)), name)
    return (
        {name: torch.as_tensor(state)} if not isinstance(state, tuple) and state is not None else {}
    )


def assert_alike(one, other, *, rtol=1e-4, atol=1e-5):
    one, other = tensors_of(one.state_dict()), tensors_of(other.state_dict())
    assert one.keys() == other.keys()
    for key, value in one.items():
        assert other[key].shape == value.shape
        assert other[key].dtype == value.dtype
        torch.testing.assert_close(other[key], value, rtol=rtol, atol=atol)


def counting(made):
    """A compiler that only notes what it is given: Python stands in for it."""

    def backend(module, inputs):
        made.append(module)
        return module.forward

    return {"backend": backend}


def fail_with(error):
    """A function that raises this, whatever it is given."""

    def fail(*args, **kwargs):
        raise error

    return fail
