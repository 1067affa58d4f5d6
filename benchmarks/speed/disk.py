"""Replay in memory-mapped files: write, sample and update, and memory a transition.

    python -m benchmarks.speed.disk --rows 10000000 --folder /path/on/the/disk

A round writes a transition, samples 256 and updates them. Times are of one thread: CPU time with
that of the kernel, and time on the wall, which counts waiting for the disk. Memory is what does
not lie in files. The files are deleted at the end.
"""

from __future__ import annotations

import argparse
import re
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.speed.replay import make_mpfa_buffer, make_mpfa_update, make_transitions
from benchmarks.speed.timing import MICROSECONDS, few_threads
from torchrl_mpfa import SignalMemmapStorage, SignalReplayBuffer

_ROUNDS = 200


def resident_bytes() -> int:
    """Memory of this process that lies in no file."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return 1024 * int(re.findall(r"RssAnon:\s+(\d+)", status)[0])


def measure(rows: int, folder: Path) -> None:
    """Print the figures of a full buffer of so many rows."""
    make_mpfa_update(_full(1000, folder / "first"))()  # What libraries allocate once.
    before, start = resident_bytes(), time.process_time()
    buffer = _full(rows, folder / "all")
    filled = time.process_time() - start
    update, transition = make_mpfa_update(buffer), make_transitions(1)
    times = []
    with few_threads(1):
        update()
        for call in (update, lambda: buffer.extend(transition)):
            start, on_wall = time.process_time(), time.perf_counter()
            for _ in range(_ROUNDS):
                call()
            taken = time.process_time() - start, time.perf_counter() - on_wall
            times.append([f"{MICROSECONDS * seconds / _ROUNDS:.0f}" for seconds in taken])
    size = sum(file.stat().st_size for file in (folder / "all").rglob("*") if file.is_file())
    print(f"{rows} transitions, {size / rows:.0f} bytes each in files")
    print(f"memory beside the files: {(resident_bytes() - before) / rows:.0f} bytes each")
    for name, (cpu, wall) in zip(("sample and update", "write one"), times, strict=True):
        print(f"{name}: {cpu} us of CPU time, {wall} us on the wall")
    print(f"filled in {filled:.0f} s of CPU time")


def _full(rows: int, folder: Path) -> SignalReplayBuffer:
    return make_mpfa_buffer(rows, storage=SignalMemmapStorage(rows, scratch_dir=folder))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure once."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", type=int, default=10_000_000)
    parser.add_argument("--folder", type=Path, help="a folder on the disk; a temporary one else")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        measure(options.rows, Path(folder))


if __name__ == "__main__":
    main()
