"""Plants by name: what the shell offers, and `build_plant` makes."""

from typing import TYPE_CHECKING

from nbs_pin.base.registry import Entry, entry

if TYPE_CHECKING:
    from nbs_pin.robots.robot import Robot
    from nbs_pin.simulation.plant import Plant

PLANTS: dict[str, Entry] = {
    "mujoco": Entry("nbs_pin.simulation.mujoco_plant:MujocoPlant"),
    "pinocchio": Entry("nbs_pin.simulation.dynamics_plant:DynamicsPlant.for_robot"),
}
"""Every plant by name. A function here takes a robot, integrator and joint_friction."""
INTEGRATORS = ("rk4", "euler", "implicitfast", "semi_implicit_euler")
"""The integrators that one plant or another knows."""


def build_plant(name: str, robot: "Robot", *, integrator: str | None = None, joint_friction: str = "drop") -> "Plant":
    """The arm as the plant of that name.

    Args:
        name: One of `PLANTS`.
        robot: The arm.
        integrator: One that the plant knows; None takes its usual one.
        joint_friction: "keep" lets the friction of the URDF act, "drop" leaves it out.

    Raises:
        ArgumentError: For an unknown name or integrator.
        RobotError: For an arm that the engine cannot build.
    """
    plant: Plant = entry("plant", name, PLANTS, ", or build one").make(
        robot, integrator=integrator, joint_friction=joint_friction
    )
    return plant
