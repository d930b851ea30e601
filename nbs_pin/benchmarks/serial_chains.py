"""Serial arms of any number of joints, for questions of scale."""

import tempfile
from pathlib import Path

from nbs_pin.robots.robot import Robot, load_robot

_LINK = """
  <link name="link{i}">
    <inertial><origin xyz="0 0 {c}"/><mass value="{m}"/>
      <inertia ixx="{t}" iyy="{t}" izz="{a}" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="joint{i}" type="revolute">
    <parent link="{parent}"/><child link="link{i}"/><origin xyz="0 0 {z}"/><axis xyz="{axis}"/>
    <limit lower="-3" upper="3" effort="{effort}" velocity="3"/>
  </joint>"""


def serial_chain(joints: int, reach: float = 1.0, mass: float = 10.0) -> Robot:
    """An arm of `joints` equal cylinders, `reach` [m] long and `mass` [kg] heavy together, axes z, y, x in turn."""
    length, weight, radius = reach / joints, mass / joints, 0.05
    transverse, axial = weight * (3 * radius**2 + length**2) / 12, weight * radius**2 / 2
    links = [
        _LINK.format(
            i=i,
            parent=f"link{i - 1}" if i else "base",
            z=length if i else 0.0,
            c=0.5 * length,
            m=weight,
            t=transverse,
            a=axial,
            axis=("0 0 1", "0 1 0", "1 0 0")[i % 3],
            effort=20.0 * mass * reach * (1.0 - i / joints),
        )
        for i in range(joints)
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"chain_{joints}.urdf"
        path.write_text(f'<robot name="chain_{joints}"><link name="base"/>{"".join(links)}\n</robot>\n')
        return load_robot(path)
