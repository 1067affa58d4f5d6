"""Time updates on a GPU beside those on the CPU, by the size of networks and batches.

    python -m benchmarks.speed.gpu

Times are of the wall clock, with the GPU's work waited for: a median of five rounds of 20 updates
by MPFA-PER, sampling and priorities included, or of 200 calls.
"""

from __future__ import annotations

import logging
import statistics
import sys
import time
from collections.abc import Iterator
from dataclasses import replace

import torch
from tensordict import TensorDict

from benchmarks.speed.replay import ACTION_SIZE, OBSERVATION_SIZE, make_mpfa_buffer
from benchmarks.speed.timing import Call
from torchrl_mpfa import (
    ActorCritic,
    SignalReplayBuffer,
    SignalTensorStorage,
    make_actor,
    make_critic,
    run_updates,
)
from torchrl_mpfa.selection import SampledBatch

CAPACITY = 100_000
PLACES = {"CPU": ("cpu", "cpu"), "GPU, buffer on the CPU": ("cuda", "cpu"), "GPU": ("cuda", "cuda")}
"""Devices of the networks and of the buffer."""
_UPDATES = 20


def milliseconds(call: Call, rounds: int) -> float:
    """Median time of a call, with what it started on the GPU [ms]."""
    found = []
    for number in range(rounds + 1):
        torch.cuda.synchronize()
        start = time.perf_counter()
        call()
        torch.cuda.synchronize()
        # The first call makes caches and buffers.
        found += [1e3 * (time.perf_counter() - start)] if number else []
    return statistics.median(found)


def make_buffer(device: str, batch_size: int) -> SignalReplayBuffer:
    """A full buffer on a device."""
    storage = SignalTensorStorage(CAPACITY, device=device)
    return make_mpfa_buffer(CAPACITY, batch_size, storage=storage)


def make_updates(networks: str, place: str, width: int, batch_size: int) -> Call:
    """A round of updates of DDPG with networks and buffer on their devices."""
    sizes = OBSERVATION_SIZE, ACTION_SIZE
    actor, critic = make_actor(*sizes, width=width), make_critic(*sizes, width=width)
    learner, buffer = (
        ActorCritic(actor.to(networks), critic.to(networks)),
        make_buffer(place, batch_size),
    )

    def move(sampled: SampledBatch) -> SampledBatch:
        return replace(sampled, batch=sampled.batch.to(networks))

    return lambda: run_updates(buffer, learner, updates=_UPDATES, prepare=move)


def replay_rows() -> Iterator[tuple[str, list[float]]]:
    """Sampling and priorities of 256 transitions by the device of the buffer."""
    times: dict[str, list[float]] = {"sampling": [], "priorities": []}
    for device in ("cpu", "cuda"):
        buffer = make_buffer(device, 256)
        batch = buffer.sample()
        signals = {key: torch.rand(256, device=device) for key in ("td_error", "action_gradient")}
        batch["signals"] = TensorDict(signals, [256])
        times["sampling"].append(milliseconds(buffer.sample, 50))
        times["priorities"].append(
            milliseconds(lambda: buffer.update_tensordict_priority(batch), 200)  # noqa: B023
        )
    yield from times.items()


def main() -> int:
    """Measure and print two tables; return the exit status."""
    if not torch.cuda.is_available():
        print("no GPU was found", file=sys.stderr)
        return 1
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    name, threads = torch.cuda.get_device_name(), torch.get_num_threads()
    print(f"{name}; CPU with {threads} threads; PyTorch {torch.__version__}\n")
    print("| replay of 256, buffer on the | CPU [ms] | GPU [ms] |\n|---|---|---|")
    for part, found in replay_rows():
        print(f"| {part} | {' | '.join(f'{value:.2f}' for value in found)} |", flush=True)
    print(f"\n| update, networks on the | {' | '.join(f'{name} [ms]' for name in PLACES)} |")
    print("|---|" + "---|" * len(PLACES))
    for batch_size in (256, 4096):
        for width in (64, 512, 2048):
            found = [
                milliseconds(make_updates(*place, width, batch_size), 5) / _UPDATES
                for place in PLACES.values()
            ]
            times = " | ".join(f"{value:.1f}" for value in found)
            print(f"| batch {batch_size:,}, 2 × {width:,} | {times} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
