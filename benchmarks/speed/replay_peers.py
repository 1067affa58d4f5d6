"""Replay of this package beside cpprb, in C++, flashbax, in JAX, and TorchRL.

    python -m benchmarks.speed.replay_peers CHART.png    draws the times of 1e5 and 1e6 transitions

The first two come with the extra ``peers``, and are left out where they are not installed.
"""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from benchmarks.speed.replay import (
    ACTION_SIZE,
    ALPHA,
    BATCH_SIZE,
    BETA,
    OBSERVATION_SIZE,
    make_mpfa_buffer,
    make_mpfa_update,
    make_stock_buffer,
    make_stock_update,
)
from benchmarks.speed.timing import MICROSECONDS, Call, Entry, entry, take_turns
from mpfa_envs.render.charts import finish, new_figure

_AT_ONCE = 100_000


def make_cpprb_update(capacity: int) -> Call:
    """One sample and one update of priorities of a full buffer of cpprb."""
    from cpprb import PrioritizedReplayBuffer

    shapes = {"obs": OBSERVATION_SIZE, "act": ACTION_SIZE, "next_obs": OBSERVATION_SIZE}
    fields: dict[str, dict[str, int]] = {name: {"shape": size} for name, size in shapes.items()}
    fields |= {"rew": {}, "done": {}}
    buffer = PrioritizedReplayBuffer(capacity, fields, alpha=ALPHA, check_for_update=False)
    generator = np.random.default_rng(0)
    for start in range(0, capacity, _AT_ONCE):
        count = min(_AT_ONCE, capacity - start)
        rows = {name: generator.standard_normal((count, size)) for name, size in shapes.items()}
        buffer.add(**rows, rew=generator.random(count), done=np.zeros(count))
    priority = generator.random(BATCH_SIZE).astype(np.float32)

    def update() -> None:
        batch = buffer.sample(BATCH_SIZE, beta=BETA)
        buffer.update_priorities(batch["indexes"], priority)

    return update


def make_flashbax_update(capacity: int) -> Call:
    """The same with flashbax, whose sample and update are a compiled program each."""
    import flashbax
    import jax
    import jax.numpy as jnp

    buffer = flashbax.make_prioritised_item_buffer(
        max_length=capacity,
        min_length=1,
        sample_batch_size=BATCH_SIZE,
        add_batches=True,
        priority_exponent=ALPHA,
        device="cpu",
    )
    row = {
        "obs": jnp.zeros(OBSERVATION_SIZE),
        "act": jnp.zeros(ACTION_SIZE),
        "rew": jnp.zeros(()),
        "next_obs": jnp.zeros(OBSERVATION_SIZE),
        "done": jnp.zeros((), bool),
    }
    state, key = buffer.init(row), jax.random.PRNGKey(0)
    add = jax.jit(buffer.add, donate_argnums=0)
    sample = jax.jit(buffer.sample)
    set_priorities = jax.jit(buffer.set_priorities, donate_argnums=0)
    count = min(10_000, capacity)
    rows = jax.tree.map(lambda value: jnp.ones((count, *value.shape), value.dtype), row)
    for _ in range(0, capacity, count):
        state = add(state, rows)
    priority = jnp.asarray(np.random.default_rng(0).random(BATCH_SIZE), jnp.float32)

    def update() -> None:
        nonlocal state, key
        key, part = jax.random.split(key)
        batch = sample(state, part)
        state = set_priorities(state, batch.indices, priority)
        jax.block_until_ready(state)

    return update


def make_torchrl_update(capacity: int) -> Call:
    """The same with TorchRL's prioritized replay."""
    return make_stock_update(make_stock_buffer(capacity))


_MAKERS = {
    "cpprb": make_cpprb_update,
    "flashbax": make_flashbax_update,
    "torchrl": make_torchrl_update,
}


def measure(name: str = "replay_1e5", *, capacity: int = 100_000, quick: bool) -> list[Entry]:
    """Sample a batch and update its priorities; ours has the ratio, to the first that is there."""
    peers = {f"{name}_{peer}": make(capacity) for peer, make in _MAKERS.items() if find_spec(peer)}
    timings = take_turns(
        {name: make_mpfa_update(make_mpfa_buffer(capacity)), **peers},
        rounds=5 if quick else 21,
        seconds=0.03 if quick else 0.1,
    )
    ours = timings[name]
    entries = [entry(peer, timings[peer].median * MICROSECONDS, "us") for peer in peers]
    baseline = next(iter(peers), None)
    ratio = None if baseline is None else ours.ratio(timings[baseline])
    value = ours.median * MICROSECONDS
    return [*entries, entry(name, value, "us", ratio=ratio, baseline=baseline)]


def draw(path: Path) -> None:
    """Measure buffers of two sizes, and draw the times as bars."""
    sizes = {"100,000": 100_000, "1,000,000": 1_000_000}
    figure, panels = new_figure(1, len(sizes), panel=(3.5, 2.2), sharey=True)
    for axes, (title, capacity) in zip(panels, sizes.items(), strict=True):
        entries = measure("replay", capacity=capacity, quick=False)
        names = {"replay": "torchrl-mpfa, three signals", "replay_torchrl": "TorchRL"}
        labels = [names.get(e["name"], e["name"].removeprefix("replay_")) for e in entries]
        values = [e["value"] for e in entries]
        colors = ["tab:blue" if e["name"] == "replay" else "tab:gray" for e in entries]
        bars = axes.barh(labels, values, color=colors)
        axes.bar_label(bars, fmt="%.0f", padding=3)
        axes.set(title=f"of {title} transitions", xlabel="CPU time [µs]")
        axes.set_xlim(0.0, 1.2 * max(values))
    figure.suptitle("Sample 256 transitions and update their priorities")
    finish(figure, [], path)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
