"""How finely a plant must be integrated."""

import numpy as np

from nbs_pin.controllers.gains import sample_configurations
from nbs_pin.robots.robot import Robot
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.loop import LONGEST_PLANT_STEP
from nbs_pin.simulation.plant import Plant


def stable_step(plant: Plant, robot: Robot, period: float) -> float | None:
    """A step short enough for RK4 to follow the plant's joint friction [s], or None for the usual one.

    Loads that appear make the arm heavier, and with that friction slower to follow.
    """
    plant = plant.at(0.0)
    if not isinstance(plant, DynamicsPlant) or plant.friction is None:
        return None
    # Friction is a damper of this slope near rest; RK4 is stable up to 2.78 of its fastest time constant.
    slope = plant.friction.viscous + plant.friction.coulomb / plant.friction.transition
    mass = plant.dynamics.mass_matrix(sample_configurations(robot, 200))
    fastest = float(np.linalg.eigvals(np.linalg.solve(mass, np.diag(slope))).real.max())
    return period / int(np.ceil(period / min(LONGEST_PLANT_STEP, 2.0 / max(fastest, 1.0)) - 1e-9))
