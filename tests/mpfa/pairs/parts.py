"""Samplers, storages, transforms, rows, ways of saving and modes that meet each other."""

import copy
import io
import pickle
import threading

import torch
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.data import (
    FlatStorageCheckpointer,
    LazyMemmapStorage,
    LazyTensorStorage,
    ListStorage,
    NestedStorageCheckpointer,
    PrioritizedSampler,
    RandomSampler,
)
from torchrl.envs.transforms import MultiStepTransform, Transform

from benchmarks.paper.methods.mw import MWSampler
from torchrl_mpfa import (
    FixedFusion,
    MPFASampler,
    PositiveBoost,
    SignalMemmapStorage,
    SignalSampler,
    SignalSliceSampler,
    SignalTensorStorage,
)
from torchrl_mpfa.methods.her import HindsightGoals
from torchrl_mpfa.methods.la3p import LA3PSampler
from torchrl_mpfa.methods.rank_per import RankPERSampler
from torchrl_mpfa.methods.reaper import ReaPERSampler
from torchrl_mpfa.samplers.uniform import CERSampler

CAPACITY, BATCH, SLICE = 48, 8, 4

SAMPLERS = {
    "mpfa": lambda **options: MPFASampler(**options),
    "fixed": lambda **options: SignalSampler(
        None, 0.6, 0.4, signals=["reward", "td_error"], adjustments=[PositiveBoost()], **options
    ),
    "slices": lambda **options: SignalSliceSampler(
        None, 0.6, 0.4, slice_len=SLICE, signals=["td_error"], **options
    ),
    "starts": lambda **options: SignalSliceSampler(
        *(None, 0.6, 0.4), slice_len=SLICE, slice_priority="start", signals=["td_error"], **options
    ),
    "la3p": lambda **options: LA3PSampler(None, 0.4, 0.0, 0.1, signals=["td_error"], **options),
    "rank": lambda **options: RankPERSampler(None, 0.7, 0.5, signals=["td_error"], **options),
    "mw": lambda **options: MWSampler(
        None, 0.6, 0.4, signals=["td_error"], replay_cap=6, **options
    ),
    "reaper": lambda **options: ReaPERSampler(None, 0.4, 0.6, signals=["td_error"], **options),
    "cer": lambda **options: CERSampler(),
    "torchrl": lambda **options: PrioritizedSampler(CAPACITY, 0.6, 0.4),
    "uniform": lambda **options: RandomSampler(),
}
FUSING = {*SAMPLERS} - {"cer", "torchrl", "uniform"}

STORAGES = {
    "tensor": lambda folder: SignalTensorStorage(CAPACITY),
    "memmap": lambda folder: SignalMemmapStorage(CAPACITY, scratch_dir=folder),
    "torchrl tensor": lambda folder: LazyTensorStorage(CAPACITY),
    "torchrl memmap": lambda folder: LazyMemmapStorage(CAPACITY, scratch_dir=folder),
    "list": lambda folder: ListStorage(CAPACITY),
}


class Negate(Transform):
    """Turns sampled observations over, as a mirror does."""

    def forward(self, tensordict):
        """Negate the observations of a batch."""
        return tensordict.set("observation", -tensordict["observation"])

    def _inv_call(self, tensordict):
        return tensordict


class Reach:
    """Rows of an episode for goals that it reached."""

    entries = ("place",)

    def __call__(self, episode, steps):
        """Repeat the steps before each goal."""
        return torch.cat([episode[: step + 1].clone() for step in steps]).exclude("place")


TRANSFORMS = {
    "none": lambda: None,
    "n steps": lambda: MultiStepTransform(3, 0.9, done_keys=["done"]),
    "hindsight": lambda: HindsightGoals(Reach(), goals=2, generator=torch.Generator("cpu")),
    "mirror": Negate,
}


def _form(*extra, **options):
    return extra, options


def _nested(normal, count, rows):
    rows["a"] = {"b": {"c": normal(2, 3)}}
    rows["next"]["team"] = {"reward": rows["next"].pop("reward")}


def _small(normal, count, rows):
    rows |= {"half": normal(5).half(), "brain": normal(1).bfloat16(), "bits": normal(3) > 0}
    rows |= {"bytes": normal(4).to(torch.int8), "flag": normal() > 0}


def _negated(normal, count, rows):
    rows["action"] = torch.complex(normal(2), normal(2)).conj().imag
    rows["next"]["reward"] = torch._neg_view(rows["next"]["reward"])


def _strided(normal, count, rows):
    rows |= {"action": normal(2).T.contiguous().T, "wide": normal(1).expand(count, 2)}


def _empty(normal, count, rows):
    rows |= {"nothing": normal(0), "scan": normal(3).masked_fill(normal(3) > 0, torch.inf)}


def _first_priority(normal, count, rows):
    rows["first"] = normal().abs() + 0.1


def _flat(normal, count, rows):
    rows["next"]["reward"] = rows["next"]["reward"].squeeze(1)


FORMS = {
    "plain": lambda normal, count, rows: None,
    "nested": _nested,
    "small": _small,
    "negated": _negated,
    "strided": _strided,
    "empty": _empty,
    "first priority": _first_priority,
    "flat": _flat,
}
NESTED_REWARD = ("next", "team", "reward")


def make_rows(form, count, seed, start):
    """Transitions of a form, episodes of seven steps, on the CPU."""
    source = torch.Generator("cpu").manual_seed(seed)

    def normal(*size):
        return torch.randn(count, *size, generator=source, device="cpu")

    step = torch.arange(start, start + count, device="cpu").unsqueeze(1)
    done, never = step % 7 == 6, torch.zeros_like(step).bool()
    rows = {
        "observation": step.float().repeat(1, 2),
        "action": normal(2),
        "episode": step // 7,
        "place": step.float(),
        **{name: never.clone() for name in ("done", "terminated", "truncated")},
        "next": {
            "observation": (step + 1).float().repeat(1, 2),
            "reward": normal(1),
            "done": done,
            "terminated": done.clone(),
            "truncated": never,
        },
    }
    FORMS[form](normal, count, rows)
    return TensorDict(rows, [count])


# Ways of saving: from a buffer and one made alike to one that continues.


def _through_file(state, *, plain):
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=plain)


def _state_dict(buffer, fresh, folder):
    fresh.load_state_dict(copy.deepcopy(buffer.state_dict()))
    return fresh


def _torch_save(buffer, fresh, folder):
    # The rows of a list are objects, and so are numbers of TorchRL's sampler.
    objects = isinstance(buffer.storage, ListStorage), type(buffer.sampler) is PrioritizedSampler
    plain = not any(objects)
    fresh.load_state_dict(_through_file(buffer.state_dict(), plain=plain))
    return fresh


def _dumps(buffer, fresh, folder):
    buffer.dumps(folder / "dump")
    fresh.loads(folder / "dump")
    return fresh


def _checkpoint(buffer, fresh, folder):
    Checkpoint(buffer=buffer).save(folder / "checkpoint")
    Checkpoint(buffer=fresh).load(folder / "checkpoint")
    return fresh


def _with_checkpointer(kind):
    def save(buffer, fresh, folder):
        for part in (buffer, fresh):
            part.storage.checkpointer = kind()
        return _dumps(buffer, fresh, folder)

    return save


SAVED = {
    "not": lambda buffer, fresh, folder: buffer,
    "state_dict": _state_dict,
    "torch.save": _torch_save,
    "dumps": _dumps,
    "pickle": lambda buffer, fresh, folder: pickle.loads(pickle.dumps(buffer)),
    "deepcopy": lambda buffer, fresh, folder: copy.deepcopy(buffer),
    "checkpoint": _checkpoint,
    "flat": _with_checkpointer(FlatStorageCheckpointer),
    "nested": _with_checkpointer(NestedStorageCheckpointer),
}
CROSSED = {"state_dict", "torch.save", "dumps", "checkpoint"}
"""Ways by which each twin loads what the other one saved."""


# Modes in which the tried buffer does what its twin does plainly.


def _compiled(work):
    torch._dynamo.reset()
    return torch.compile(work, backend="eager")()


def _in_inference(work):
    with torch.inference_mode():
        return work()


def _on_default_device(work):
    torch.set_default_device("meta")
    try:
        return work()
    finally:
        torch.set_default_device(None)


def _in_thread(work):
    results, errors = [], []

    def run():
        try:
            results.append(work())
        except Exception as error:
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    if errors:
        raise errors[0]
    return results[0]


MODES = {
    "plain": lambda work: work(),
    "compiled": _compiled,
    "inference": _in_inference,
    "default device": _on_default_device,
    "thread": _in_thread,
}

ROUNDS = {"one batch": 1, "three batches": 3}

CHANGED = {
    "nothing": lambda sampler: None,
    "alpha": lambda sampler: setattr(sampler, "alpha", 0.9),
    "fusion": lambda sampler: setattr(sampler, "fusion", FixedFusion({"td_error": 2.0})),
    "adjustments": lambda sampler: setattr(sampler, "adjustments", [PositiveBoost(2.0, "none")]),
    "level": lambda sampler: setattr(sampler, "positive_above", 0.3),
}
"""What of a sampler is set after its first use."""
