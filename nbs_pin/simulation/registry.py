"""Plants by name, for the command line and `build_plant`."""

from typing import TYPE_CHECKING

from nbs_pin.base.registry import Entry, entry

if TYPE_CHECKING:
    from nbs_pin.robots.robot import Robot
    from nbs_pin.simulation.plant import Plant

PLANTS: dict[str, Entry] = {
    "mujoco": Entry("nbs_pin.simulation.mujoco_plant:MujocoPlant"),
    "pinocchio": Entry("nbs_pin.simulation.dynamics_plant:DynamicsPlant.for_robot"),
}
"""All plants by name; each entry takes a robot, integrator, joint_friction and joint_stops."""
INTEGRATOR_NAMES = ("rk4", "euler", "implicitfast", "semi_implicit_euler")
"""All integrators that some plant supports."""


def build_plant(
    name: str, robot: "Robot", *, integrator: str | None = None, joint_friction: str = "drop", joint_stops: str = "drop"
) -> "Plant":
    """The plant of that name for the arm.

    Args:
        name: One of `PLANTS`.
        robot: The arm.
        integrator: One that the plant supports; None takes its default.
        joint_friction: "keep" applies the joint friction of the URDF, "drop" omits it.
        joint_stops: "keep" stops the joints at their position limits, "drop" lets them pass.

    Raises:
        ArgumentError: If name or integrator is unknown.
        RobotError: If the engine cannot build the arm.
    """
    plant: Plant = entry("plant", name, PLANTS, ", or build one").make(
        robot, integrator=integrator, joint_friction=joint_friction, joint_stops=joint_stops
    )
    return plant
