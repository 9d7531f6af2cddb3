"""Results out to where models are used: a Modelica class with the values, joints of a robot's description."""

from __future__ import annotations

import shutil
from importlib.resources import files
from pathlib import Path
from xml.etree import ElementTree

import pytest

from fmu_build import load
from fmu_build.syntax import Literal
from fmuid.core.campaign import RobotSpec
from fmuid.core.errors import CampaignError
from fmuid.identification.modelica_class import short_class
from fmuid.identification.robot_description import described

URDF = """\
<robot name="arm">
  <!-- two links -->
  <link name="base"/>
  <joint name="shoulder" type="revolute"><limit effort="10"/></joint>
  <joint name="elbow" type="revolute"><dynamics friction="9" damping="9"/></joint>
</robot>
"""
MJCF = """\
<mujoco model="arm">
  <worldbody><body name="upper"><joint name="shoulder" type="hinge" damping="9"/></body></worldbody>
</mujoco>
"""


def value_of(flat, name: str) -> float:
    binding = flat.variables[name].binding
    assert isinstance(binding, Literal)
    return float(binding.value)


def test_the_class_has_the_values_and_is_the_model_otherwise(tmp_path: Path) -> None:
    shutil.copy(str(files("fmuid.demo").joinpath("Bench.mo")), tmp_path / "Bench.mo")
    text = short_class("DriveIdentified", "Bench.Drive", {"rotor.J": 3.5e-3, "shaft.c": 20.25}, {})
    (tmp_path / "DriveIdentified.mo").write_text(text)
    flat = load(tmp_path / "DriveIdentified.mo", "DriveIdentified", roots=[tmp_path])
    assert (value_of(flat, "rotor.J"), value_of(flat, "shaft.c")) == (3.5e-3, 20.25)
    assert value_of(flat, "load.J") == 4e-3  # as in the model


def test_an_array_is_modified_as_a_whole_and_what_cannot_be_is_said() -> None:
    starts = {"table[1,1]": 0.0, "table[1,2]": 1.0, "table[2,1]": 10.0, "table[2,2]": 1.0}
    text = short_class("Found", "A.B", {"table[2,2]": 0.9, "lone[2]": 4.0}, starts)
    assert "table = {{0.0, 1.0}, {10.0, 0.9}}" in text
    assert "// Cannot be written as a modifier: lone." in text


def test_joints_get_their_friction_and_the_rest_stays(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(URDF)
    joints = {"shoulder": {"friction": "tau_c", "damping": "d"}, "elbow": {"friction": "0.5*tau_c"}}
    text = described(RobotSpec(tmp_path / "arm.urdf", joints), {"tau_c": 0.3, "d": 0.02})
    root = ElementTree.fromstring(text)
    dynamics = {j.get("name"): j.find("dynamics").attrib for j in root.iter("joint")}  # type: ignore[union-attr]
    assert dynamics == {
        "shoulder": {"friction": "0.3", "damping": "0.02"},
        "elbow": {"friction": "0.15", "damping": "9"},
    }
    assert "<!-- two links -->" in text
    assert '<limit effort="10" />' in text
    assert (tmp_path / "arm.urdf").read_text() == URDF


def test_a_mujoco_model_has_armature_too(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(MJCF)
    joints = {"shoulder": {"friction": "tau_c", "damping": "d", "armature": "J*n**2"}}
    text = described(RobotSpec(tmp_path / "arm.xml", joints), {"tau_c": 0.3, "d": 0.02, "J": 1e-4, "n": 50.0})
    (joint,) = ElementTree.fromstring(text).iter("joint")
    assert (joint.get("frictionloss"), joint.get("damping"), joint.get("armature")) == ("0.3", "0.02", "0.25")


@pytest.mark.parametrize(
    ("content", "joints", "message"),
    [
        (URDF, {"sholder": {"friction": "1"}}, "has no joint 'sholder'; did you mean 'shoulder'?"),
        (URDF, {"elbow": {"armature": "1"}}, "URDF has no joint armature"),
        ("<sdf/>", {"elbow": {"friction": "1"}}, "'sdf' is neither a URDF robot nor a MuJoCo model"),
        ("<robot", {"elbow": {"friction": "1"}}, "cannot be read"),
    ],
)
def test_what_does_not_fit_the_description_is_one_line(tmp_path: Path, content, joints, message) -> None:
    (tmp_path / "arm.urdf").write_text(content)
    with pytest.raises(CampaignError) as refused:
        described(RobotSpec(tmp_path / "arm.urdf", joints), {})
    assert message in str(refused.value)
