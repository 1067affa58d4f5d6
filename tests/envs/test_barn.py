from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

import mpfa_envs
from mpfa_envs import (
    Filtered,
    TaskConfig,
    WorldFileError,
    evaluate,
    load_policy,
    run_tasks,
    summarize,
    world_tasks,
)
from mpfa_envs.evaluation.results import barn_score
from mpfa_envs.paths.distance import DistanceField, FreeGrid
from mpfa_envs.worlds.barn import BARN_WORLDS, barn_task, barn_world, barn_worlds, load_barn

SAMPLE = Path(mpfa_envs.__file__).parent / "data" / "barn" / "barn_sample.npz"
WORLD = "<sdf version='1.6'><world name='default'>MODELS</world></sdf>"
MODEL = (
    "<model name='unit_cylinder'><static>1</static><pose frame=''>AT 0 0 0 0</pose>"
    "<link name='link'><collision name='collision'><geometry><cylinder><radius>0.075</radius>"
    "<length>1</length></cylinder></geometry></collision></link></model>\n"
)


def test_there_are_twenty_worlds_from_open_to_narrow() -> None:
    worlds = [barn_world(index) for index in range(20)]
    counts = [len(world.cylinders) for world in worlds]
    assert len(BARN_WORLDS) == 20 and min(counts) >= 181 and max(counts) <= 365
    assert sum(counts[10:]) > sum(counts[:10])
    for world in worlds:
        edges = np.array([cylinder.bounds for cylinder in world.cylinders])
        # The bounding box of every world of the benchmark, moved to the middle of the room.
        assert edges[:, :2].min(axis=0) == pytest.approx((-2.25, -7.0))
        assert edges[:, 2:].max(axis=0) == pytest.approx((2.25, 2.6))
        assert {cylinder.radius for cylinder in world.cylinders} == {0.075}


@pytest.mark.parametrize("index", [0, 19])
def test_the_task_can_be_solved_with_something_to_spare(index: int) -> None:
    task = barn_task()
    field = DistanceField(FreeGrid(barn_world(index), distance=0.25), task.goal)
    assert math.dist(task.start[:2], task.goal) == 10.0
    assert 9.8 < field.at(*task.start[:2]) < 15.0
    i, j = field.grid.index(*task.start[:2])
    assert math.isfinite(field.lengths[i, j])


def publish(folder: Path, indices: Iterable[int] = (0, 7), worlds: str = "world_files") -> Path:
    """Write some of the twenty worlds as the benchmark publishes them."""
    (folder / worlds).mkdir(parents=True, exist_ok=True)
    (folder / "path_files").mkdir(exist_ok=True)
    with np.load(SAMPLE, allow_pickle=False) as sample:
        for index in indices:
            number = BARN_WORLDS[index]
            np.save(folder / "path_files" / f"path_{number}.npy", sample[f"path_{number}"])
            places = sample[f"cyl_{number}"].tolist()
            models = "".join(MODEL.replace("AT", f"{x:.6f} {y:.6f}") for x, y in places)
            text = WORLD.replace("MODELS", models)
            (folder / worlds / f"world_{number}.world").write_text(text, encoding="utf-8")
    return folder


@pytest.mark.parametrize("form", ["folder", "in a folder", "challenge", "zip"])
def test_the_archive_has_the_worlds_and_paths_that_come_with_the_package(
    tmp_path: Path, form: str
) -> None:
    worlds = "." if form == "challenge" else "world_files"
    some = (0, 7, 19)
    archive = publish(tmp_path / "all" / "BARN_dataset", some, worlds)
    if form == "in a folder":
        archive = archive.parent
    elif form == "zip":
        archive = Path(shutil.make_archive(str(tmp_path / "barn"), "zip", archive.parent))
    found = list(load_barn(archive))
    assert [world.name for world, _ in found] == [f"barn300-{BARN_WORLDS[n]}" for n in some]
    shipped = list(barn_worlds())
    for n, (world, length) in zip(some, found, strict=True):
        expected, expected_length = shipped[n]
        assert length == expected_length
        assert (world.size, world.start_regions) == (expected.size, expected.start_regions)
        assert world.goal_regions == expected.goal_regions
        places = [(c.x, c.y, c.radius) for c in world.cylinders]
        wanted = [(c.x, c.y, c.radius) for c in expected.cylinders]
        assert np.array(places) == pytest.approx(np.array(wanted), abs=1e-3)


def test_the_task_of_an_archive_is_driven_and_scored(tmp_path: Path) -> None:
    archive = publish(tmp_path / "BARN_dataset")
    word = f"barn:{archive}"
    tasks = world_tasks(word)
    assert [task.world.name for task in tasks] == ["barn300-5", "barn300-110"]
    assert {(task.task, task.max_steps) for task in tasks} == {(barn_task(), 1000)}
    assert [task.world.name for task in world_tasks(word, episodes=1)] == ["barn300-5"]
    here = [world_tasks("barn")[index] for index in (0, 7)]
    trained = load_policy("td3-rooms")
    policy = Filtered(trained, TaskConfig(**trained.env_arguments).make_filter())
    results = evaluate(policy, word, physics="kinematic")
    expected = run_tasks(policy, here, **{**policy.env_arguments, "physics": "kinematic"})
    assert [each.time_s for each in results] == [each.time_s for each in expected]
    for result, task in zip(results, tasks, strict=True):
        assert task.reference_path is not None
        assert result.barn_score == barn_score(
            result.success, time_s=result.time_s, reference_path=task.reference_path
        )
    with pytest.warns(UserWarning, match="got one for 'kobuki' with robot='burger'"):
        slow = evaluate(policy, word, physics="kinematic", robot="burger")
    # At 0.22 m/s, on paths that may be shorter than the reference.
    scores = [each.barn_score or 0.0 for each in slow]
    assert all(score == 0.0 or 0.125 <= score < 0.15 for score in scores)
    summary = summarize([*results, *evaluate(policy, "A", episodes=1, physics="kinematic")])
    assert summary["barn_score"].value == pytest.approx(
        np.mean([result.barn_score for result in results])
    )


def test_the_score_is_that_of_the_challenge() -> None:
    # Optimal times of 5 s: its eighth from 40 s on, its fourth up to 20 s.
    times = {0.1: 0.25, 19.9: 0.25, 20.0: 0.25, 25.0: 0.2, 32.0: 5 / 32, 40.0: 0.125, 99.0: 0.125}
    for time, score in times.items():
        assert barn_score(True, time_s=time, reference_path=10.0) == pytest.approx(score)
        assert barn_score(False, time_s=time, reference_path=10.0) == 0.0


def damaged(change: Callable[[Path], object], tmp_path: Path) -> Path:
    archive = publish(tmp_path / "BARN_dataset")
    change(archive)
    return archive


def world_110(text: str) -> Callable[[Path], object]:
    return lambda folder: (folder / "world_files" / "world_110.world").write_text(text)


def array(values: object) -> Callable[[Path], object]:
    return lambda folder: np.save(folder / "path_files" / "path_110.npy", values, allow_pickle=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (shutil.rmtree, "neither a folder nor an archive"),
        (lambda folder: shutil.rmtree(folder / "world_files"), "has no world of BARN"),
        (lambda folder: shutil.rmtree(folder / "path_files"), "path_5.npy: cannot|no world of"),
        (lambda folder: (folder / "path_files/path_110.npy").unlink(), "path_110.npy: cannot be"),
        (array([[0, 0, 0]]), r"path_110.npy: must have shape \[N, 2\], got \[1, 3\]"),
        (array([[0.0, math.nan]]), "must have cells from 0 to 99"),
        (array([[0, 100]]), "must have cells from 0 to 99"),
        (array([[{}, {}]]), "path_110.npy: is no array: Object arrays"),
        (
            lambda folder: (folder / "path_files/path_110.npy").write_bytes(b"0" * 2_000_000),
            "path_110.npy: cannot be read: .* 1000000 bytes",
        ),
        (world_110("<sdf><world>"), "world_110.world:1: is not XML"),
        (
            world_110(WORLD.replace("MODELS", MODEL.replace("AT", "90 0"))),
            "world_110.world: .* must lie in",
        ),
        (
            world_110(WORLD.replace("MODELS", MODEL.replace("AT", "nan 0"))),
            "world_110.world:1: pose must be 6 numbers",
        ),
    ],
)
@pytest.mark.parametrize("zipped", [False, True])
def test_an_archive_that_is_no_archive_is_rejected_by_the_name_of_the_file(
    tmp_path: Path, change: Callable[[Path], object], message: str, zipped: bool
) -> None:
    archive = damaged(change, tmp_path)
    if zipped and archive.exists():
        archive = Path(shutil.make_archive(str(archive), "zip", archive.parent, archive.name))
    with pytest.raises(WorldFileError, match=message):
        world_tasks(f"barn:{archive}")


def test_a_damaged_zip_is_rejected(tmp_path: Path) -> None:
    archive = publish(tmp_path / "BARN_dataset")
    path = Path(shutil.make_archive(str(archive), "zip", archive.parent, archive.name))
    content = path.read_bytes()
    place = content.index(b"world_110.world") + 200
    path.write_bytes(content[:place] + bytes(50) + content[place + 50 :])
    with pytest.raises(WorldFileError, match=r"world_110\.world: cannot be read"):
        world_tasks(f"barn:{path}")
    path.write_bytes(content[:1000])
    with pytest.raises(WorldFileError, match=r"BARN_dataset\.zip: cannot be read"):
        world_tasks(f"barn:{path}")
