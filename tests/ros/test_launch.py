"""The launch file and its parameters name what the node has."""

from __future__ import annotations

import ast
import os
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

pytest.importorskip("onnxruntime", reason="exported policies are of the extra onnx")

import mpfa_envs
from mpfa_envs import load_policy
from mpfa_envs.deploy import Pilot
from mpfa_envs.ros.controller import Controller
from tests.envs.exported import card

FOLDER = Path(mpfa_envs.__file__).parent / "ros"
ROOT = Path(__file__).parents[2]
DOCS = (ROOT / "docs" / "robot.md").read_text(encoding="utf-8")


def parameters(module: str) -> dict[str, object]:
    """The table of a node's parameters, which is read without rclpy."""
    module = {"policy_node.py": "parameters.py"}.get(module, module)
    for each in ast.parse((FOLDER / module).read_text(encoding="utf-8")).body:
        if isinstance(each, ast.AnnAssign) and ast.unparse(each.target) == "PARAMETERS":
            assert each.value is not None
            found: dict[str, object] = ast.literal_eval(each.value)
            return found
    raise AssertionError(module)


LAUNCHES = sorted((FOLDER / "launch").glob("*.launch.xml"))


@pytest.mark.parametrize("file", LAUNCHES, ids=lambda file: file.name)
def test_a_launch_file_passes_arguments_that_the_nodes_declare(file: Path) -> None:
    root = ElementTree.parse(file).getroot()
    declared = {each.get("name") for each in root.findall("arg")}
    text = file.read_text(encoding="utf-8")
    assert set(re.findall(r"\$\(var (\w+)\)", text)) == declared
    for each in root.iter("executable"):
        command = each.get("cmd") or ""
        module = re.findall(r"-m mpfa_envs\.ros\.(\w+)", command)[0]
        assert set(re.findall(r"-p (\w+):=", command)) <= {
            *parameters(f"{module}.py"),
            "use_sim_time",
        }
    for each in root.iter("include"):
        name = (each.get("file") or "").removeprefix("$(dirname)/")
        other = ElementTree.parse(FOLDER / "launch" / name).getroot()
        takes = {arg.get("name") for arg in other.findall("arg")}
        assert {arg.get("name") for arg in each.iter("arg")} == takes


def test_arguments_of_ones_own_come_last_and_a_shell_takes_them_apart() -> None:
    root = ElementTree.parse(FOLDER / "launch" / "turtlebot.launch.xml").getroot()
    (node,) = root.iter("executable")
    command = node.get("cmd") or ""
    assert command.endswith(" $(var ros_args)") and node.get("shell") == "true"
    # The node itself gets the signals, and not the shell.
    assert command.startswith("exec ")


@pytest.mark.parametrize("file", sorted((FOLDER / "launch").glob("*.yaml")), ids=lambda f: f.stem)
def test_each_robot_has_a_launch_file(file: Path) -> None:
    text = file.with_suffix(".launch.xml").read_text(encoding="utf-8")
    assert f"$(dirname)/{file.name}" in text


def test_the_simulated_robot_is_that_of_the_policies_for_rooms() -> None:
    root = ElementTree.parse(FOLDER / "launch" / "simulated.launch.xml").getroot()
    defaults = {each.get("name"): each.get("default") for each in root.iter("arg")}
    assert defaults["robot"] == load_policy("td3-rooms").env_arguments["robot"]["name"]


def places_in_a_prefix() -> dict[str, Path]:
    """Where in a prefix the wheel puts which file or folder for ROS 2."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    section = text.partition("[tool.hatch.build.targets.wheel.shared-data]")[2].partition("\n\n")[0]
    return {there: ROOT / here for here, there in re.findall(r'"(.+)" = "(.+)"', section)}


def test_a_prefix_has_what_ros2_run_and_ros2_launch_look_for() -> None:
    places = places_in_a_prefix()
    assert set(places) == {
        "share/ament_index/resource_index/packages/mpfa_envs",
        "share/mpfa_envs/package.xml",
        "share/mpfa_envs/launch",
        "lib/mpfa_envs/policy_node",
        "lib/mpfa_envs/robot_node",
    }
    package = ElementTree.parse(places["share/mpfa_envs/package.xml"]).getroot()
    assert package.findtext("name") == "mpfa_envs"
    assert package.findtext("version") == mpfa_envs_version()
    for name in ("policy_node", "robot_node"):
        script = places[f"lib/mpfa_envs/{name}"]
        assert os.access(script, os.X_OK) and f"-m mpfa_envs.ros.{name} " in script.read_text()
        assert (FOLDER / f"{name}.py").exists()


def mpfa_envs_version() -> str:
    """The version of the wheel."""
    text = (ROOT / "torchrl_mpfa" / "__init__.py").read_text(encoding="utf-8")
    return re.findall(r'__version__ = "(.+)"', text)[0]


@pytest.mark.parametrize("file", sorted((FOLDER / "launch").glob("*.yaml")), ids=lambda f: f.stem)
def test_parameter_files_fit_the_node_and_the_shipped_policies(file: Path) -> None:
    values = yaml.safe_load(file.read_text(encoding="utf-8"))["/**"]["ros__parameters"]
    known = parameters("policy_node.py")
    assert {name: type(value) for name, value in values.items()} == {
        name: type(known[name]) for name in values
    }
    options = {name: values[name] for name in ("robot", "mount", "silent") if name in values}
    pilot = Pilot(card(), lambda seen: seen, **options)
    assert pilot.robot.name == values["robot"]
    Controller(pilot, stop_distance=values["stop_distance"])


def test_commands_in_the_docs_name_what_exists() -> None:
    launches = re.findall(r"ros2 launch mpfa_envs (\S+)((?: \w+:=\S+)+)", DOCS)
    assert launches
    for file, words in launches:
        root = ElementTree.parse(FOLDER / "launch" / file).getroot()
        declared = {each.get("name") for each in root.findall("arg")}
        assert set(re.findall(r"(\w+):=", words)) <= declared
    runs = re.findall(r"-m mpfa_envs\.ros\.(\w+) --ros-args(.*)", DOCS)
    assert len(runs) >= 3
    for module, words in runs:
        known = {*parameters(f"{module}.py"), "use_sim_time"}
        assert set(re.findall(r"-p (\w+):=", words)) <= known


@pytest.mark.parametrize("module", ["policy_node.py", "robot_node.py"])
def test_every_parameter_is_in_the_docs(module: str) -> None:
    missing = [name for name in parameters(module) if f"`{name}`" not in DOCS]
    assert missing == []
