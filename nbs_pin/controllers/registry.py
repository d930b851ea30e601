"""Control laws by name, for the command line and `build_law`."""

from typing import TYPE_CHECKING, Any

from nbs_pin.base.registry import Entry, entry

if TYPE_CHECKING:
    from nbs_pin.controllers.controller import Controller
    from nbs_pin.robots.robot import Robot

_LAWS = "nbs_pin.controllers"
LAWS: dict[str, Entry] = {
    "nbs": Entry(f"{_LAWS}.neural_backstepping:NeuralBackstepping.for_robot"),
    "nbs-paper": Entry(f"{_LAWS}.neural_backstepping:paper_controller_for"),
    "adaptive": Entry(f"{_LAWS}.adaptive_law:AdaptiveLaw.for_robot"),
    "slotine-li": Entry(f"{_LAWS}.slotine_li:SlotineLi.for_robot"),
    "sliding-mode": Entry(f"{_LAWS}.sliding_mode:SlidingMode.for_robot"),
    "computed-torque": Entry(f"{_LAWS}.computed_torque:ComputedTorque.for_robot"),
    "pd-plus": Entry(f"{_LAWS}.pd:PD.for_robot", {"feedforward": "reference"}),
    "pd-gravity": Entry(f"{_LAWS}.pd:PD.for_robot", {"feedforward": "gravity"}),
    "pid": Entry(f"{_LAWS}.pid:PID.for_robot"),
}
"""All laws by name; each entry takes a robot and, as keywords, the settings of `build_law` that it supports."""


def build_law(name: str, robot: "Robot", **settings: Any) -> "Controller":
    """The law of that name with default gains for the arm.

    Args:
        name: One of `LAWS`.
        robot: The arm.
        settings: bandwidth [rad/s], period [s], friction, dynamics, seed; those that the law does not take are ignored.

    Raises:
        ArgumentError: For an unknown name or a number out of range.
    """
    law: Controller = entry("controller", name, LAWS, ", a .nbs file, or build one").make(robot, **settings)
    return law
