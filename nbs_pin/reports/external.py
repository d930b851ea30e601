"""The torque from outside along a run, by the arm's own description."""

from typing import Any

from jaxtyping import Float

from nbs_pin.base.records import Run
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.momentum_observer import MomentumObserver
from nbs_pin.reports.captions import friction_of
from nbs_pin.robots.robot import Robot


def external_torque(run: Run, robot: Robot) -> Float[Any, "rows *batch n"]:
    """What a momentum observer of the arm makes of the run [N·m, N]; friction counts as known if it was simulated."""
    friction = JointFriction.of(robot) if friction_of(run) == "keep" else None
    return MomentumObserver.for_robot(robot, friction=friction).observe(run).torque
