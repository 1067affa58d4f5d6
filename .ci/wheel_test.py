"""Build sdist and wheel, look inside, install the wheel where nothing else is, and use it.

An editable install makes everything in the repository importable; a user's has only the wheel.
The new environment borrows the dependencies of the one that runs this, but none of its ``.pth``
files, so that its editable install cannot stand in for the wheel.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tempfile
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("torchrl_mpfa", "mpfa_envs")
# What `ros2 run` and `ros2 launch` find a package by, in a prefix.
FOR_ROS = (
    "share/ament_index/resource_index/packages/mpfa_envs",
    "share/mpfa_envs/package.xml",
    "share/mpfa_envs/launch/turtlebot4.launch.xml",
    "lib/mpfa_envs/policy_node",
    "lib/mpfa_envs/robot_node",
)

USE = """
import importlib.metadata
import importlib.util
import sys
import warnings
from pathlib import Path

warnings.simplefilter("ignore")
import torch
from tensordict import TensorDict

import mpfa_envs
import torchrl_mpfa
from mpfa_envs import POLICIES, evaluate, load_policy, make_navigation_env, summarize
from torchrl_mpfa import (
    ActorCritic,
    MPFASampler,
    SignalReplayBuffer,
    SignalTensorStorage,
    make_actor,
    make_critic,
    methods,
    run_updates,
)

installed, version = Path(sys.argv[1]).resolve(), sys.argv[2]
for package in (torchrl_mpfa, mpfa_envs):
    assert installed in Path(package.__file__).resolve().parents, package.__file__
assert torchrl_mpfa.__version__ == version, torchrl_mpfa.__version__
assert importlib.metadata.version("torchrl-mpfa") == version
for name in ("envs", "tests", "examples", "benchmarks"):
    spec = importlib.util.find_spec(name)
    for place in (spec.submodule_search_locations or [spec.origin]) if spec else []:
        assert installed not in Path(place).resolve().parents, f"the wheel has {name}: {place}"

# PyBullet has no wheels for later Pythons.
for physics in ("kinematic", "wheels") if sys.version_info < (3, 12) else ("kinematic",):
    env = make_navigation_env("A", physics=physics, seed=0)
    rollout = env.rollout(5, break_when_any_done=False)
    env.close()
assert rollout.batch_size == (5,), rollout.batch_size
buffer = SignalReplayBuffer(
    storage=SignalTensorStorage(100), sampler=MPFASampler(100), batch_size=4
)
buffer.extend(rollout)
batch = buffer.sample()
batch["signals"] = TensorDict(
    {"td_error": torch.rand(4), "action_gradient": torch.rand(4)}, [4]
)
buffer.update_tensordict_priority(batch)
print("weights of the signals:", buffer.sampler.weights, "compiled:", buffer.sampler.compiled)

# A plugin: a signal and a method by name.
methods.register_signal("ones", lambda learner, batch: torch.ones(len(batch)))
methods.METHODS["mine"] = methods.Scaled("mine", signals=["td_error", "ones"])
replay = methods.make_replay("mine", capacity=100, batch_size=4)
replay.buffer.extend(rollout)
learner = ActorCritic(make_actor(24, 2), make_critic(24, 2), **methods.loss_options("mine"))
own = methods.OwnSignals(replay.signals)
run_updates(replay.buffer, learner, updates=2, prepare=own.before(learner))
assert replay.buffer.stats()["share/ones"] > 0
print("a signal of a plugin:", replay.buffer.sampler.weights)

shipped = {name: load_policy(name) for name in POLICIES}
print("shipped policies:", ", ".join(shipped))
policy = shipped["td3-paper"]
results = evaluate(policy, "rooms-100", episodes=10, physics="kinematic")
print("success of the shipped policy:", summarize(results)["success"])
assert sum(result.success for result in results) >= 8, results
"""


def build(folder: Path) -> Path:
    """Build the sdist, and the wheel from it.

    Args:
        folder: Where they go.

    Returns:
        The wheel.

    Raises:
        SystemExit: If the sdist has results.
    """
    # hatchling is in this environment: building needs no other one, and no network.
    _run(sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT))
    (sdist,) = folder.glob("*.tar.gz")
    (wheel,) = folder.glob("*.whl")
    with tarfile.open(sdist) as archive:
        results = [name for name in archive.getnames() if "/docs/results/" in name]
    if results:
        raise SystemExit(f"the sdist has {len(results)} files of results: {results[:3]}")
    print(f"built {sdist.name} and {wheel.name}", flush=True)
    return wheel


def check_contents(wheel: Path) -> None:
    """Compare the wheel's list of files with the packages of the repository.

    Raises:
        SystemExit: If a file is missing or does not belong there.
    """
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    tops = {name.split("/")[0] for name in names}
    strangers = {t for t in tops if t not in PACKAGES and not t.endswith((".dist-info", ".data"))}
    if strangers:
        raise SystemExit(f"the wheel has more than the packages: {sorted(strangers)}")
    for package, source in zip(PACKAGES, (ROOT, ROOT / "envs"), strict=True):
        needed = (path for path in (source / package).rglob("*") if path.is_file())
        missing = {
            str(path.relative_to(source)) for path in needed if "__pycache__" not in path.parts
        } - names
        if missing:
            raise SystemExit(f"the wheel lacks {sorted(missing)}")
    prefix = {name.partition(".data/data/")[2] for name in names}
    if lacking := set(FOR_ROS) - prefix:
        raise SystemExit(f"the wheel lacks {sorted(lacking)} for ROS 2")
    if not any(re.fullmatch(r"mpfa_envs/assets/.+\.yaml", name) for name in names):
        raise SystemExit("the wheel lacks the worlds in mpfa_envs/assets")
    print(f"{len(names)} files, of {', '.join(sorted(tops))}", flush=True)


def check_tag(wheel: Path, folder: Path) -> None:
    """Compare the wheel's platform with the symbols of its compiled library, as binutils list them.

    A package index takes no ``linux_x86_64``.

    Args:
        wheel: The wheel.
        folder: Where the library goes.

    Raises:
        SystemExit: If the wheel promises to load where a symbol is missing, or promises too little.
    """
    platform = wheel.stem.split("-")[-1]
    with zipfile.ZipFile(wheel) as archive:
        libraries = [name for name in archive.namelist() if name.endswith(".so")]
        paths = [archive.extract(name, folder) for name in libraries]
    if not paths:
        if platform != "any":
            raise SystemExit(f"the wheel for {platform} has no compiled loops")
        return
    if not platform.startswith("manylinux_2_") or shutil.which("objdump") is None:
        print(f"the wheel is for {platform}, whose symbols are not looked at")
        return
    listed = subprocess.run(["objdump", "-T", *paths], capture_output=True, text=True, check=True)
    newest = max(int(minor) for minor in re.findall(r"\(GLIBC_2\.(\d+)", listed.stdout))
    promised = int(platform.split("_")[2])
    if promised != max(newest, 17):
        raise SystemExit(f"the wheel is for {platform}, its symbols are of glibc 2.{newest}")
    print(f"the wheel is for {platform}, by symbols of glibc 2.{newest}", flush=True)


def install(wheel: Path, folder: Path) -> tuple[Path, Path]:
    """Install the wheel in a new environment that sees this one's dependencies.

    Args:
        wheel: The wheel.
        folder: Where the environment goes.

    Returns:
        Its interpreter and its ``site-packages``.
    """
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    _run(str(python), "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", str(wheel))
    paths = sysconfig.get_paths(vars={"base": str(folder), "platbase": str(folder)})
    packages = Path(paths["purelib"])
    # A path in a .pth file is searched for modules, not for further .pth files. The ending of the
    # name puts it behind the new environment's own packages.
    own = sysconfig.get_paths()
    lines = sorted({own["purelib"], own["platlib"]})
    (packages / "zz_dependencies.pth").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return python, packages


def main() -> None:
    """Build, look, install, use."""
    with tempfile.TemporaryDirectory(prefix="wheel-test-") as name:
        folder = Path(name)
        wheel = build(folder / "dist")
        check_contents(wheel)
        check_tag(wheel, folder / "library")
        python, packages = install(wheel, folder / "venv")
        elsewhere = folder / "elsewhere"
        elsewhere.mkdir()
        version = wheel.name.split("-")[1]
        _run(str(python), "-c", USE, str(packages), version, cwd=elsewhere)
    print("wheel test passed")


def _run(*command: str, cwd: Path = ROOT) -> None:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    done = subprocess.run(command, cwd=cwd, env=environment, check=False)
    if done.returncode != 0:
        raise SystemExit(f"wheel test failed: {' '.join(command[:4])} exited {done.returncode}")


if __name__ == "__main__":
    main()
