"""The launch file and its parameters name what the node has."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

pytest.importorskip("onnxruntime", reason="exported policies are of the extra onnx")

import mpfa_envs
from mpfa_envs.deploy import Pilot
from mpfa_envs.ros.controller import Controller
from tests.envs.exported import card

FOLDER = Path(mpfa_envs.__file__).parent / "ros"
DOCS = (Path(__file__).parents[2] / "docs" / "robot.md").read_text(encoding="utf-8")


def parameters(module: str) -> dict[str, object]:
    """The table of a node's parameters, which is read without rclpy."""
    module = {"policy_node.py": "parameters.py"}.get(module, module)
    for each in ast.parse((FOLDER / module).read_text(encoding="utf-8")).body:
        if isinstance(each, ast.AnnAssign) and ast.unparse(each.target) == "PARAMETERS":
            assert each.value is not None
            found: dict[str, object] = ast.literal_eval(each.value)
            return found
    raise AssertionError(module)


def test_the_launch_file_passes_arguments_that_the_node_declares() -> None:
    root = ElementTree.parse(FOLDER / "launch" / "turtlebot.launch.xml").getroot()
    declared = {each.get("name") for each in root.iter("arg")}
    command = next(root.iter("executable")).get("cmd") or ""
    assert set(re.findall(r"\$\(var (\w+)\)", command)) == declared
    assert (
        (FOLDER / re.findall(r"-m mpfa_envs\.ros\.(\w+)", command)[0]).with_suffix(".py").exists()
    )
    assert set(re.findall(r"-p (\w+):=", command)) <= {
        *parameters("policy_node.py"),
        "use_sim_time",
    }


@pytest.mark.parametrize("file", sorted((FOLDER / "launch").glob("*.yaml")), ids=lambda f: f.stem)
def test_parameter_files_fit_the_node_and_the_shipped_policies(file: Path) -> None:
    values = yaml.safe_load(file.read_text(encoding="utf-8"))["mpfa_policy"]["ros__parameters"]
    known = parameters("policy_node.py")
    assert {name: type(value) for name, value in values.items()} == {
        name: type(known[name]) for name in values
    }
    options = {name: values[name] for name in ("robot", "mount", "silent") if name in values}
    pilot = Pilot(card(), lambda seen: seen, **options)
    assert pilot.robot.name == values["robot"]
    Controller(pilot, stop_distance=values["stop_distance"])


def test_commands_in_the_docs_name_what_exists() -> None:
    root = ElementTree.parse(FOLDER / "launch" / "turtlebot.launch.xml").getroot()
    declared = {each.get("name") for each in root.iter("arg")}
    launches = re.findall(r"ros2 launch (\S+)((?: \w+:=\S+)+)", DOCS)
    assert launches
    for file, words in launches:
        assert (FOLDER / "launch" / file).exists()
        assert set(re.findall(r"(\w+):=", words)) <= declared
        for params in re.findall(r"params:=(\S+)", words):
            assert (FOLDER / "launch" / params).exists()
    runs = re.findall(r"-m mpfa_envs\.ros\.(\w+) --ros-args(.*)", DOCS)
    assert len(runs) >= 3
    for module, words in runs:
        known = {*parameters(f"{module}.py"), "use_sim_time"}
        assert set(re.findall(r"-p (\w+):=", words)) <= known


@pytest.mark.parametrize("module", ["policy_node.py", "robot_node.py"])
def test_every_parameter_is_in_the_docs(module: str) -> None:
    missing = [name for name in parameters(module) if f"`{name}`" not in DOCS]
    assert missing == []
