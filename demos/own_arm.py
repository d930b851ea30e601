"""Your own arm from a URDF file: written, tracked, replayed; and a slip in the file caught before it does harm.

What to see: an arm of three joints that the package has never met follows its motion with a steady error below a
micro-radian, and its replay draws it as capsules, for it has no meshes. Then a mass of "nan" is refused with the line
it stands in; Pinocchio alone would read it as a massless link and compute on.
"""

import sys
from pathlib import Path

import numpy as np

import nbs_pin as nbs

LINK = """
  <link name="{name}">
    <inertial>
      <origin xyz="0 0 {half}"/>
      <mass value="{mass}"/>
      <inertia ixx="{i}" iyy="{i}" izz="{j}" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>"""
JOINT = """
  <joint name="{name}" type="revolute">
    <parent link="{parent}"/><child link="{child}"/>
    <origin xyz="0 0 {height}"/><axis xyz="{axis}"/>
    <limit lower="-2.5" upper="2.5" effort="{effort}" velocity="6"/>
  </joint>"""


def urdf(fore_mass: str = "1.2") -> str:
    """A turning column, an upper arm and a fore-arm, rods 0.4 m long."""
    parts = ['<robot name="my_arm">\n  <link name="base"/>']
    parent = "base"
    for child, mass, joint, height, axis, effort in (
        ("column", "3", "turn", 0.0, "0 0 1", 60),
        ("upper", "2", "shoulder", 0.4, "0 1 0", 80),
        ("fore", fore_mass, "elbow", 0.4, "0 1 0", 40),
    ):
        parts.append(LINK.format(name=child, half=0.2, mass=mass, i=0.03, j=0.002))
        parts.append(JOINT.format(name=joint, parent=parent, child=child, height=height, axis=axis, effort=effort))
        parent = child
    return "".join([*parts, "\n</robot>\n"])


def main(out: Path = Path("out/demo/own_arm"), duration: float = 4.0) -> tuple[float, str]:
    """Returns the steady error [rad] and what the package says of the broken file."""
    out.mkdir(parents=True, exist_ok=True)
    path = out / "my_arm.urdf"
    path.write_text(urdf())

    robot = nbs.load_robot(path)
    reference = nbs.Sinusoid.for_robot(robot, frequency=2.0)
    controller = nbs.NeuralBackstepping.for_robot(robot)
    start = reference(0.0).q + np.array([0.3, -0.3, 0.3])
    run = nbs.simulate(nbs.MujocoPlant(robot), controller, reference, duration, 0.001, q0=start)
    error = float(nbs.metrics.rms_error(run, after=0.7 * duration).max())
    page = nbs.replay(run, out / "replay.html")
    print(f"{robot.name}: steady error {error:.1e} rad; open {page}")

    broken = out / "broken.urdf"
    broken.write_text(urdf(fore_mass="nan"))
    try:
        nbs.load_robot(broken)
    except nbs.NbsPinError as refusal:
        print(f"refused: {refusal}")
        return error, str(refusal)
    return error, ""


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("out/demo/own_arm"))
