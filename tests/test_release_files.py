"""What a hosted service reads: the image of the demo, and the checks of every change."""

from __future__ import annotations

import os
import re
import runpy
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

import torchrl_mpfa

ROOT = Path(__file__).resolve().parent.parent
TOOLS = ("sh", "dirname", "mktemp", "rm", "xargs", "cp", "git")


def lines(name: str) -> list[str]:
    return (ROOT / name).read_text(encoding="utf-8").splitlines()


def test_citation_and_changelog_have_the_version_of_the_package() -> None:
    found = re.search(r"^## \[([\d.]+)\] - (\S+)$", "\n".join(lines("CHANGELOG.md")), re.MULTILINE)
    assert found is not None
    version, date = found.groups()
    assert {f"version: {version}", f"date-released: {date}"} <= {*lines("CITATION.cff")}
    assert version == torchrl_mpfa.__version__


HERE = ("linux_x86_64", "manylinux_2_36_x86_64", "manylinux_2_35_x86_64")


@pytest.mark.parametrize(
    ("library", "platforms", "tag"),
    [
        (b"\0GLIBC_2.2.5\0GLIBC_2.29\0GLIBC_2.14\0", HERE, "manylinux_2_29_x86_64"),
        (b"\0GLIBC_2.2.5\0", HERE, "manylinux_2_17_x86_64"),
        (b"\0GLIBC_2.27\0", ("manylinux_2_39_riscv64",), "manylinux_2_27_riscv64"),
        (b"\0GLIBC_2.29\0GLIBC_ABI_DT_RELR\0", HERE, "manylinux_2_36_x86_64"),
        (
            b"libc.musl-x86_64.so.1",
            ("musllinux_1_2_x86_64", "linux_x86_64"),
            "musllinux_1_2_x86_64",
        ),
        (b"\xcf\xfa\xed\xfe", ("macosx_14_0_arm64", "macosx_13_0_arm64"), "macosx_14_0_arm64"),
        (b"\0GLIBC_2.29\0", ("linux_sparc64",), "linux_sparc64"),
    ],
)
def test_a_wheel_is_for_platforms_that_have_the_symbols_of_its_library(
    library: bytes, platforms: tuple[str, ...], tag: str
) -> None:
    hook = runpy.run_path(str(ROOT / ".ci" / "hatch_build.py"))
    assert hook["platform_tag"](library, platforms) == tag


def test_the_hosted_checks_are_those_of_the_repository() -> None:
    workflow = yaml.safe_load((ROOT / ".github/workflows/checks.yml").read_text(encoding="utf-8"))
    steps = [step.get("run") for job in workflow["jobs"].values() for step in job["steps"]]
    assert ".ci/run" in steps
    assert os.access(ROOT / ".ci" / "run", os.X_OK)


def test_the_image_copies_what_there_is_and_runs_a_target_of_make_as_no_root() -> None:
    steps = [line.split() for line in lines("Dockerfile") if not line.startswith("#")]
    words = [step[0] for step in steps]
    assert words.index("USER") < words.index("COPY") < words.index("CMD")
    for step in steps:
        if step[0] == "COPY":
            sources = [word for word in step[1:-1] if not word.startswith("--")]
            assert sources and all((ROOT / source).exists() for source in sources)
            assert "--chown=robot" in step  # Else `make` could not write there.
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
    program, *goals = re.findall(r'"([^"]+)"', lines("Dockerfile")[words.index("CMD") - len(words)])
    assert program == "make" and goals and set(goals) <= set(targets)


def test_the_image_leaves_out_what_git_does() -> None:
    left_out = {line.removeprefix("**/") for line in lines(".dockerignore")}
    assert {line.strip("/") for line in lines(".gitignore")} | {".git"} == left_out


def test_the_tests_run_on_each_python_in_a_copy_that_is_removed(tmp_path: Path) -> None:
    """Interpreters and ``make`` only pretend."""
    copy, programs, log = tmp_path / "copy", tmp_path / "bin", tmp_path / "log"
    (copy / ".ci").mkdir(parents=True)
    programs.mkdir()
    shutil.copy(ROOT / ".ci" / "versions", copy / ".ci")
    (copy / "new.txt").touch()
    for tool in TOOLS:
        found = shutil.which(tool)
        if found is None:
            pytest.skip(f"{tool} is not installed")
        (programs / tool).symlink_to(found)

    def add(name: str, text: str) -> None:
        (programs / name).write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
        (programs / name).chmod(0o755)

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [copy / ".ci" / "versions", *words],
            env={"PATH": str(programs), "HOME": str(tmp_path), "TMPDIR": str(tmp_path)},
            capture_output=True,
            text=True,
            check=False,
        )

    subprocess.run(["git", "init", "--quiet"], cwd=copy, check=True)
    add("python3.12", "exit 0")
    add("python3.13", "exit 127")
    # Fails on 3.10, or where a file is missing.
    add("make", f'echo "$@" >> {log}; [ -e "$2/new.txt" ] && case "$*" in *3.10*) exit 1 ;; esac')
    missing = run()
    assert missing.returncode != 0 and "no Python 3.10 found" in missing.stderr
    assert not log.exists()
    add("python3.10", "exit 0")
    failed = run("3.10", "3.12", "ARGS=-k tree")
    assert failed.returncode == 1
    assert "the tests failed on 3.10\n" in failed.stderr
    calls = [line.split() for line in log.read_text(encoding="utf-8").splitlines()]
    assert [(call[0], *call[2:]) for call in calls] == [
        ("-C", "test", f"PYTHON=python{version}", "ARGS=-k", "tree") for version in ("3.10", "3.12")
    ]
    assert not any(Path(call[1]).exists() for call in calls)
    assert run("3.12").returncode == 0
