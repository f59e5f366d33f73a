"""Links of a robot from files: where they are, their meshes, and what is wrong with such a file."""

from __future__ import annotations

from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware.views.robot import Mesh, Robot, pose_of, read_robot
from tests.views.client import page_of
from tests.views.conftest import Serve

TOML = 'format = "skinware-links"\nversion = 1\n'
URDF = """<robot name="r">
  <link name="base"><visual><geometry><box size="1 1 1"/></geometry></visual></link>
  <link name="arm">
    <visual>
      <origin xyz="0 0 0.5"/>
      <geometry><mesh filename="package://robot_description/meshes/arm.stl" scale="0.001 0.001 0.001"/></geometry>
    </visual>
    <visual><geometry><mesh filename="meshes/arm.dae"/></geometry></visual>
    <visual><geometry><mesh filename="meshes/none.stl"/></geometry></visual>
  </link>
  <link name="hand"/>
  <joint name="shoulder" type="revolute">
    <parent link="base"/><child link="arm"/><origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/>
  </joint>
  <joint name="wrist" type="fixed"><parent link="arm"/><child link="hand"/><origin xyz="1 0 0"/></joint>
</robot>"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A robot's package as ROS has it; its URDF."""
    for folder in ("urdf", "meshes"):
        (tmp_path / "robot_description" / folder).mkdir(parents=True)
    (tmp_path / "robot_description/meshes/arm.stl").write_bytes(b"solid arm")
    urdf = tmp_path / "robot_description/urdf/robot.urdf"
    urdf.write_text(URDF)
    return urdf


def test_links_of_a_urdf(package: Path) -> None:
    robot = read_robot(package)
    assert list(robot.poses) == ["base", "arm", "hand"]
    assert np.allclose(robot.poses["hand"] @ [0, 0, 0, 1], [0, 1, 1, 1])
    (mesh,) = robot.meshes
    assert (mesh.frame, mesh.file.read_bytes()) == ("arm", b"solid arm")
    assert np.allclose(mesh.pose @ [1000, 0, 0, 1], [1, 0, 0.5, 1])
    assert robot.left_out == (
        "base: a visual that is no mesh",
        "arm: meshes/arm.dae is not there",
        "arm: meshes/none.stl is not there",
    )


def test_links_of_a_file_of_ours(tmp_path: Path) -> None:
    (tmp_path / "chest.STL").write_bytes(b"solid chest")
    file = tmp_path / "links.toml"
    file.write_text(
        TOML + '[[link]]\nframe = "chest"\nmesh = "chest.STL"\nscale = 0.001\nxyz = [0, 0, 1]\n[[link]]\nframe = "arm"'
    )
    robot = read_robot(file)
    assert np.array_equal(robot.poses["chest"], pose_of((0, 0, 1), (0, 0, 0)))
    assert np.array_equal(robot.poses["arm"], np.eye(4))
    assert [mesh.file.name for mesh in robot.meshes] == ["chest.STL"]
    assert np.array_equal(robot.meshes[0].pose, np.diag([0.001, 0.001, 0.001, 1]))


def test_rotations_are_about_fixed_axes() -> None:
    turned = pose_of((1, 2, 3), (np.pi / 2, 0, np.pi / 2)) @ [0, 1, 0, 1]  # y to z, and z stays
    assert np.allclose(turned, [1, 2, 4, 1])


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "no file of links"),
        ("no toml", "not TOML"),
        (TOML + '[[link]]\nmesh = "a.stl"', ":3: Object missing required field frame"),
        (TOML + '[[link]]\nframe = "a"\nmesh = "b.stl"', ":3: there is no mesh"),
        (TOML + '[[link]]\nframe = "a"\nmesh = "links.toml"', "is no STL file"),
        (TOML + '[[link]]\nframe = "a"\nxyz = [1, 2]', ":5"),
        (TOML + '[[link]]\nframe = "a"\nxyz = [1, 2, nan]', ":3: a number is not finite"),
        (TOML + '[[link]]\nframe = "a"\nscale = 0', ":5"),
        (TOML + '[[link]]\nframe = "a"\n[[link]]\nframe = "a"', ":5: frame 'a' stands here twice"),
        (TOML.replace("1", "2"), "version 2"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path: Path, text: str, why: str) -> None:
    file = tmp_path / "links.toml"
    file.write_text(text)
    with pytest.raises(ConfigurationError) as error:
        read_robot(file)
    assert why in str(error.value)
    assert str(file) in str(error.value)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "not XML"),
        ("<robot", "not XML"),
        ("<model/>", "it is a <model>"),
        ("<robot><link/></robot>", "<link> without 'name'"),
        ("<robot><joint/></robot>", "a joint without 'link'"),
        ('<robot><joint><parent link="a"/><child link="a"/></joint><link name="a"/></robot>', "above itself"),
        (URDF.replace("1 0 0", "1 0 x"), "could not convert"),
        (URDF.replace("1 0 0", "1 0"), "'1 0' are not three numbers"),
    ],
)
def test_what_is_wrong_with_a_urdf_is_said(tmp_path: Path, text: str, why: str) -> None:
    file = tmp_path / "robot.urdf"
    file.write_text(text)
    with pytest.raises(ConfigurationError) as error:
        read_robot(file)
    assert why in str(error.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    for name in ("links.toml", "robot.urdf"):
        with pytest.raises(ConfigurationError, match="No such file"):
            read_robot(tmp_path / name)


def test_meshes_are_served(serving: Serve, tmp_path: Path) -> None:
    (tmp_path / "arm.stl").write_bytes(b"solid arm")
    pose, in_frame = pose_of((1, 2, 3), (0, 0, 1)), np.diag([2.0, 2.0, 2.0, 1.0])
    robot = Robot({"arm": pose}, (Mesh("arm", tmp_path / "arm.stl", in_frame),))
    with serving(robot=robot) as url, page_of(url) as page:
        page.pull()
        (link,) = page.skin["links"]
        assert link["frame"] == "arm"
        assert np.allclose(np.reshape(link["pose"], (4, 4)), pose @ in_frame)
        with urlopen(url + link["mesh"]) as answer:
            assert answer.read() == b"solid arm"
