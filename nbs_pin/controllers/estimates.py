"""What an adaptive law has learned, in the units of an engineer, and as a model."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nbs_pin.base.shown import Cells, Shown
from nbs_pin.base.units import counted, units_of
from nbs_pin.controllers.adapting_model import Duals
from nbs_pin.controllers.matrix_logistic import logistic_and_cut
from nbs_pin.controllers.unknowns import KINDS, LOAD_AT, NO_MASS, Unknowns, into_tree, model_body
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.identified import IdentifiedDynamics
from nbs_pin.dynamics.pseudo_inertia import PARAMETER_NAMES, PARAMETER_UNITS, inertial_parameters, pseudo_inertia
from nbs_pin.kernels.layout import NumberCode, Packed
from nbs_pin.kernels.symmetric4 import FARTHEST
from nbs_pin.kernels.tree_layout import ARMATURE, BASE, BODY
from nbs_pin.robots.robot import Robot

_PARAMETERS = tuple(zip(PARAMETER_NAMES, PARAMETER_UNITS, strict=True))


@dataclass(frozen=True, eq=False, repr=False)
class Estimate(Shown):
    """What an `AdaptiveLaw` believes at one instant, or at many: then every array has their leading axes.

    Example:
        >>> import nbs_pin as nbs
        >>> law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(nbs.load_robot("panda")), load_mass=4.0)
        >>> estimate = law.estimate()
        >>> bool(abs(estimate.load_mass) < 1e-9), estimate.names[0]
        (True, 'load at panda_hand_tcp m [kg]')
        >>> estimate.dynamics().robot.name
        'panda'
    """

    robot: Robot
    tree: Packed
    """The model that was believed at first."""
    unknowns: Unknowns
    values: Float[np.ndarray, "*batch k"]
    """What `names` lists: ten parameters of every body in Pinocchio's order, then the numbers of the joints."""
    deviation: Float[np.ndarray, " k"] | None = None
    """How far each value may be off, like a standard deviation (docs/theory.md §10); None without a run."""
    unexcited: tuple[str, ...] = ()
    """Directions of the values that the run did not show at all, each of the width of its interval, in words."""
    friction: JointFriction | None = None
    """The friction that the law feeds forward, which is that of the model where friction does not adapt."""

    @property
    def names(self) -> list[str]:
        """What every value is, with its unit."""
        bodies = [f"{body.name} {name} [{unit}]" for body in self.unknowns.bodies for name, unit in _PARAMETERS]
        of = units_of(self.robot.prismatic)
        own = []
        for number in self.unknowns.numbers:
            what, quantity = KINDS[number.code]
            own.append(f"{self.robot.joint_names[number.joint]} {what} [{getattr(of[number.joint], quantity)}]")
        return bodies + own

    def _facts(self) -> Iterable[str]:
        own = []
        if self._load >= 0 and self.values.ndim == 1:
            name = self.unknowns.bodies[self._load].name.removeprefix(LOAD_AT)
            centre = ", ".join(f"{1e3 * x:z.0f}" for x in self.load_centre)
            there = f"load {float(self.load_mass):.3g} kg at ({centre}) mm of {name}"
            own = [there if abs(self.load_mass) > NO_MASS else f"no load at {name}"]
        hidden = [f"{counted(len(self.unexcited), 'direction')} not excited"] if self.unexcited else []
        counts = (
            f"{counted(len(self.unknowns.bodies), 'body', 'bodies')}, {counted(len(self.unknowns.numbers), 'number')}"
        )
        return self.robot.name, *own, counts, *hidden

    def _cells(self) -> Cells:
        if self.deviation is None:
            return Cells()
        rows = [
            (name, f"{value:z.3g}", f"{off:.2g}")
            for name, value, off in zip(self.names, self.values.tolist(), self.deviation.tolist(), strict=True)
        ]
        return Cells(("", "believed", "may be off by"), rows)

    @property
    def load_mass(self) -> Float[np.ndarray, "*batch"]:
        """Mass of the load [kg], 0 where none adapts; negative where the link seems lighter than in the model."""
        return self._load_values[..., 0]

    @property
    def load_centre(self) -> Float[np.ndarray, "*batch 3"]:
        """Centre of mass of the load in the frame that carries it [m]; 0 for a load below a gram."""
        mass = np.where(np.abs(self.load_mass) > NO_MASS, self.load_mass, np.inf)
        return np.asarray(self._load_values[..., 1:4] / mass[..., None])

    @property
    def load_inertia(self) -> Float[np.ndarray, "*batch 3 3"]:
        """Inertia of the load about its centre of mass, in the directions of that frame [kg·m²]."""
        p, centre = pseudo_inertia(self._load_values), self.load_centre
        spread = p[..., :3, :3] - self.load_mass[..., None, None] * centre[..., :, None] * centre[..., None, :]
        return np.asarray(np.trace(spread, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - spread)

    @property
    def viscous(self) -> Float[np.ndarray, "*batch n"]:
        """Viscous friction per joint [N·m·s/rad, N·s/m], 0 where it does not adapt."""
        return self._numbers(NumberCode.VISCOUS)

    @property
    def coulomb(self) -> Float[np.ndarray, "*batch n"]:
        """Coulomb friction per joint [N·m, N], 0 where it does not adapt."""
        return self._numbers(NumberCode.COULOMB)

    @property
    def rotor_inertia(self) -> Float[np.ndarray, "*batch n"]:
        """Rotor inertia per joint [kg·m², kg], the believed one where it does not adapt."""
        own = self.tree.weights[BASE:].reshape(-1, BODY)[:, ARMATURE]
        adapts = any(number.code == NumberCode.ROTOR for number in self.unknowns.numbers)
        return self._numbers(NumberCode.ROTOR) if adapts else np.broadcast_to(own, (*self.values.shape[:-1], len(own)))

    @property
    def offset(self) -> Float[np.ndarray, "*batch n"]:
        """Constant torque of the law against a disturbance per joint [N·m, N], 0 where it does not adapt."""
        return self._numbers(NumberCode.OFFSET)

    @property
    def parameters(self) -> Float[np.ndarray, "*batch n 10"]:
        """Ten inertial parameters of every joint's body about the joint, in Pinocchio's order, the load included."""
        n, turns = self.robot.nv, into_tree(self.robot)
        known = np.array([model_body(self.tree, i) for i in range(n)])
        bodies = np.tile(known, (*self.values.shape[:-1], 1, 1, 1))
        for k, body in enumerate(self.unknowns.bodies):
            p = body.place @ pseudo_inertia(self.values[..., 10 * k : 10 * k + 10]) @ body.place.T
            bodies[..., body.joint, :, :] += p if body.is_load else p - body.known
        back = np.swapaxes(turns, -1, -2)  # a rotation
        return inertial_parameters(back @ bodies @ turns)

    def dynamics(self) -> IdentifiedDynamics:
        """The model with these bodies, rotors and friction, of one memory, which laws, `compare` and files take.

        Estimates of friction and rotors a little below zero become zero, and constant torques are left out. Raises
        ArgumentError for an arm with a body without mass or extent.
        """
        friction = self.friction
        if any(number.code == NumberCode.COULOMB for number in self.unknowns.numbers):
            own = np.maximum(self.viscous, 0.0), np.maximum(self.coulomb, 0.0)
            friction = JointFriction(*own, self.unknowns.transition)
        return IdentifiedDynamics(self.robot, self.parameters, friction, np.maximum(self.rotor_inertia, 0.0))

    @property
    def _load(self) -> int:
        """Which body is the load, −1 where none adapts."""
        return next((k for k, body in enumerate(self.unknowns.bodies) if body.is_load), -1)

    @property
    def _load_values(self) -> np.ndarray:
        k = self._load
        return np.zeros((*self.values.shape[:-1], 10)) if k < 0 else self.values[..., 10 * k : 10 * k + 10]

    def _numbers(self, code: NumberCode) -> Float[np.ndarray, "*batch n"]:
        found, begin = np.zeros((*self.values.shape[:-1], self.robot.nv)), 10 * len(self.unknowns.bodies)
        for k, number in enumerate(self.unknowns.numbers):
            if number.code == code:
                found[..., number.joint] = self.values[..., begin + k]
        return found


def estimate_of(robot: Robot, tree: Packed, unknowns: Unknowns, duals: Float[np.ndarray, "*batch m"]) -> Estimate:
    """The estimate that the memory of a law holds."""
    given = Duals.of(duals, len(unknowns.bodies))
    x, _ = logistic_and_cut(given.bodies)
    parts = []
    for k, body in enumerate(unknowns.bodies):
        p = body.factor @ x[..., k, :, :] @ body.factor.T
        back = np.linalg.inv(body.place)
        parts.append(inertial_parameters(back @ (p - body.known if body.is_load else p) @ back.T))
    for k, number in enumerate(unknowns.numbers):
        share = 1.0 / (1.0 + np.exp(-np.clip(given.numbers[..., k], -FARTHEST, FARTHEST)))
        parts.append((number.lowest + number.width * share)[..., None])
    return Estimate(robot, tree, unknowns, np.concatenate(parts, axis=-1))
