"""The package's policy drives in ir-sim, a simulator of others."""

import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest

import ir_sim
from mpfa_envs import Box, Cylinder, Polygon, Task, World, WorldTask
from mpfa_envs.robots.resolve import resolve_robot

ROBOT = resolve_robot("kobuki")


def room(**shapes):
    world = World(name="room", size=(8.0, 6.0), **shapes)
    return WorldTask(world, Task((-3.0, 0.0, 0.0), (3.0, 0.0)))


def test_a_world_of_ir_sim_has_walls_around_the_room_and_each_obstacle():
    shapes = {
        "boxes": (Box(-1.0, -1.0, 1.0, 0.0),),
        "cylinders": (Cylinder(2.0, 1.0, 0.3),),
        "polygons": (Polygon(((0.0, 1.0), (1.0, 1.0), (0.0, 2.0))),),
    }
    made = ir_sim.irsim_world(room(**shapes), ROBOT)
    below, above, left, right, box, cylinder, polygon = made["obstacle"]
    assert [each["state"][:2] for each in (below, above, left, right)] == [
        *([0.0, -3.1], [0.0, 3.1]),
        *([-4.1, 0.0], [4.1, 0.0]),
    ]
    assert box == {
        "shape": {"name": "rectangle", "length": 2.0, "width": 1.0},
        "state": [0.0, -0.5, 0.0],
    }
    assert cylinder == {"shape": {"name": "circle", "radius": 0.3}, "state": [2.0, 1.0, 0.0]}
    assert polygon["shape"]["vertices"] == [[0.0, 1.0], [1.0, 1.0], [0.0, 2.0]]


def test_walkers_of_ir_sim_start_at_free_places_away_from_the_robot():
    each = room(boxes=(Box(-1.0, -1.0, 1.0, 0.0),))
    made = ir_sim.irsim_world(each, ROBOT, walkers=3, behavior="dash", seed=1)
    walkers = [one for one in made["obstacle"] if "behavior" in one]
    assert len(walkers) == 3
    for one in walkers:
        x, y = one["state"][:2]
        assert each.world.clearance(x, y) > one["shape"]["radius"]
        assert math.dist((x, y), each.task.start[:2]) > 1.5


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_the_shipped_policy_arrives_in_twenty_tasks_of_ir_sim_and_touches_nothing():
    pytest.importorskip("irsim", reason="an extra")
    pytest.importorskip("onnx", reason="exported policies are of the extra onnx")
    drives = ir_sim.main([])
    assert [end.outcome for end in drives] == ["success"] * 20


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_the_robot_arrives_among_walkers_of_ir_sim_and_the_picture_is_written(tmp_path):
    pytest.importorskip("irsim", reason="an extra")
    pytest.importorskip("onnx", reason="exported policies are of the extra onnx")
    path = tmp_path / "drives.png"
    options = ["--episodes", "2", "--walkers", "2", "--picture", str(path)]
    assert len(ir_sim.main(options)) == 2
    assert path.stat().st_size > 1000


def test_the_table_of_drives_counts_who_arrived_and_has_the_fastest_touch():
    drives = [
        ir_sim.Drive("success", 10.0, 0.4, []),
        ir_sim.Drive("success", 20.0, 0.4, []),
        ir_sim.Drive("collision", 3.0, 0.2, []),
        ir_sim.Drive("timeout", 120.0, 0.7, []),
    ]
    assert ir_sim.table(drives).splitlines()[1].split() == ["4", "2", "1", "0.20", "15.0"]


class Recorded:
    """A robot of ir-sim that keeps the orders it gets."""

    def __init__(self):
        self.state, self.collision, self.orders = np.zeros((3, 1)), False, []
        self.robot = self

    def get_lidar_scan(self):
        return {"angle_min": 0.0, "angle_increment": 0.1, "ranges": np.ones(63), "range_max": 3.0}

    def step(self, order):
        self.orders.append(tuple(order[:, 0].tolist()))

    def end(self, ending_time):
        pass


class Ahead:
    """A pilot that orders its decisions' number, without a ramp."""

    period, decisions = 0.1, 0

    def __init__(self, latency):
        self.latency = latency

    def begin(self, goal, map_center):
        pass

    def arrived(self, pose):
        return False

    def decide(self, scan, pose, speeds, *, time):
        self.decisions += 1
        return SimpleNamespace(linear=float(self.decisions), angular=0.0)

    def ramp(self, last, wanted, passed):
        return wanted


@pytest.mark.parametrize(("latency", "steps"), [(0.0, 0), (0.1, 2), (0.25, 5)])
def test_an_order_acts_as_many_steps_after_its_scan_as_the_latency_has(monkeypatch, latency, steps):
    robot = Recorded()
    monkeypatch.setattr(ir_sim, "LONGEST", 0.5)
    module = SimpleNamespace(make=lambda *arguments, **options: robot)
    monkeypatch.setitem(sys.modules, "irsim", module)
    end = ir_sim.drive(Ahead(latency), {}, (3.0, 0.0), 0)
    speeds = [linear for linear, _ in robot.orders]
    assert end.outcome == "timeout"
    assert speeds[: steps + 4] == [0.0] * steps + [1.0, 1.0, 2.0, 2.0]
