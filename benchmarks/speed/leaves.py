"""Passes over all priorities on a GPU, where there is one, against TorchRL's trees on the CPU."""

from __future__ import annotations

import time
from typing import Any

import torch
from torch import Tensor
from torchrl.data.replay_buffers.samplers.prioritized import SumSegmentTreeFp64

from benchmarks.speed.timing import MICROSECONDS, Call, Entry, entry, take_turns
from torchrl_mpfa.samplers.trees import SumLeaves, leaves_of, set_leaves

BATCH_SIZE = 256


def _round(tree: Any, capacity: int, device: torch.device) -> Call:
    """Sample a batch, read its leaves, and write them again; all is back on ``device`` then."""
    home = device if isinstance(tree, SumLeaves) else torch.device("cpu")
    set_leaves(torch.arange(capacity).to(home), torch.rand(capacity).double().to(home), tree)
    share = torch.rand(BATCH_SIZE, dtype=torch.double, device=device)

    def call() -> Tensor:
        mass = share.to(home) * tree.query(0, capacity)
        slots = tree.scan_lower_bound(mass)
        leaf = leaves_of(tree, slots)
        # What a learner gives comes from the device, and goes to it.
        set_leaves(slots.to(device).to(home), leaf.to(device).to(home), tree)
        if device.type != "cpu":
            torch.accelerator.synchronize()
        return leaf

    return call


def measure(*, quick: bool) -> list[Entry]:
    """Sample and write 256 of 1e5 and of 1e6 leaves; the ratio is against trees."""
    device = torch.accelerator.current_accelerator(check_available=True) or torch.device("cpu")
    found: list[Entry] = []
    for power in (5, 6):
        capacity, name, baseline = 10**power, f"leaves_1e{power}_{device.type}", f"trees_1e{power}"
        calls = {
            name: _round(SumLeaves(capacity, device), capacity, device),
            baseline: _round(SumSegmentTreeFp64(capacity), capacity, device),
        }
        rounds, seconds = (5, 0.03) if quick else (21, 0.1)
        # What a GPU does takes no time of the CPU.
        clock = time.process_time if device.type == "cpu" else time.perf_counter
        timings = take_turns(calls, rounds=rounds, seconds=seconds, clock=clock)
        ratio = timings[name].ratio(timings[baseline])
        found += [
            entry(baseline, timings[baseline].median * MICROSECONDS, "us"),
            entry(name, timings[name].median * MICROSECONDS, "us", ratio=ratio, baseline=baseline),
        ]
    return found
