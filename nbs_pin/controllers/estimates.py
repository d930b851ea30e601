"""What an adaptive law has learned, in the units of an engineer, and as a model."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nbs_pin.base.shown import Shown
from nbs_pin.controllers.adapting_model import Duals
from nbs_pin.controllers.matrix_logistic import logistic_and_cut
from nbs_pin.controllers.unknowns import UnknownBody, Unknowns, into_tree, model_body
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.identified import IdentifiedDynamics
from nbs_pin.dynamics.pseudo_inertia import inertial_parameters
from nbs_pin.kernels.layout import NumberCode, Packed
from nbs_pin.kernels.tree_layout import ARMATURE, BASE, BODY
from nbs_pin.robots.robot import Robot

_NO_MASS = 1e-3  # [kg]


@dataclass(frozen=True, eq=False, repr=False)
class Estimate(Shown):
    """What an `AdaptiveLaw` believes with one memory, or with many: then every array has their leading axes.

    Example:
        >>> import nbs_pin as nbs
        >>> law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(nbs.load_robot("panda")), load_mass=4.0)
        >>> estimate = law.estimate()
        >>> bool(abs(estimate.load_mass) < 1e-9), estimate.load_centre
        (True, array([0., 0., 0.]))
        >>> estimate.dynamics().robot.name
        'panda'
    """

    robot: Robot
    tree: Packed
    """The model that was believed at first."""
    unknowns: Unknowns
    duals: Float[np.ndarray, "*batch m"]

    def _facts(self) -> Iterable[str]:
        own = []
        if self._load is not None and self.duals.ndim == 1:
            centre = ", ".join(f"{1e3 * x:.0f}" for x in self.load_centre)
            own = [f"load {float(self.load_mass):.3g} kg at ({centre}) mm of {self._load.name}"]
        return self.robot.name, *own, f"{len(self.unknowns.bodies)} bodies, {len(self.unknowns.numbers)} numbers"

    @property
    def load_mass(self) -> Float[np.ndarray, "*batch"]:
        """Mass of the load [kg], 0 where none adapts; negative where the link seems lighter than in the model."""
        return np.asarray(self._load_body[..., 3, 3])

    @property
    def load_centre(self) -> Float[np.ndarray, "*batch 3"]:
        """Centre of mass of the load in the frame that carries it [m]; 0 for a load below a gram."""
        p = self._load_body
        return np.asarray(p[..., :3, 3] / np.where(np.abs(p[..., 3, 3]) > _NO_MASS, p[..., 3, 3], np.inf)[..., None])

    @property
    def load_inertia(self) -> Float[np.ndarray, "*batch 3 3"]:
        """Inertia of the load about its centre of mass, in the directions of that frame [kg·m²]."""
        p, centre = self._load_body, self.load_centre
        spread = p[..., :3, :3] - p[..., 3, 3, None, None] * centre[..., :, None] * centre[..., None, :]
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
        return self._numbers(NumberCode.ROTOR) if adapts else np.broadcast_to(own, (*self.duals.shape[:-1], len(own)))

    @property
    def offset(self) -> Float[np.ndarray, "*batch n"]:
        """Constant torque of the law against a disturbance per joint [N·m, N], 0 where it does not adapt."""
        return self._numbers(NumberCode.OFFSET)

    @property
    def parameters(self) -> Float[np.ndarray, "*batch n 10"]:
        """Ten inertial parameters of every joint's body about the joint, in Pinocchio's order, the load included."""
        n = self.robot.nv
        known = np.array([model_body(self.tree, i) for i in range(n)])
        bodies = np.tile(known, (*self.duals.shape[:-1], 1, 1, 1))
        for body, p in zip(self.unknowns.bodies, self._bodies(), strict=True):
            bodies[..., body.joint, :, :] += p - body.known
        back = np.swapaxes(into_tree(self.robot), -1, -2)  # a rotation
        return inertial_parameters(back @ bodies @ np.swapaxes(back, -1, -2))

    def dynamics(self) -> IdentifiedDynamics:
        """The model with these bodies, rotors and friction, of one memory, which laws, `compare` and files take.

        Estimates of friction and rotors a little below zero become zero.
        """
        friction = None
        if any(number.code == NumberCode.COULOMB for number in self.unknowns.numbers):
            own = np.maximum(self.viscous, 0.0), np.maximum(self.coulomb, 0.0)
            friction = JointFriction(*own, self.unknowns.transition)
        return IdentifiedDynamics(self.robot, self.parameters, friction, np.maximum(self.rotor_inertia, 0.0))

    @property
    def _load(self) -> UnknownBody | None:
        return next((body for body in self.unknowns.bodies if body.frame is not None), None)

    @property
    def _load_body(self) -> np.ndarray:
        """The pseudo-inertia of the load in its own frame; zero where none adapts."""
        for body, p in zip(self.unknowns.bodies, self._bodies(), strict=True):
            if body.frame is not None:
                back = np.linalg.inv(body.frame)
                return np.asarray(back @ (p - body.known) @ back.T)
        return np.zeros((*self.duals.shape[:-1], 4, 4))

    def _bodies(self) -> list[np.ndarray]:
        x, _ = logistic_and_cut(Duals.of(self.duals, len(self.unknowns.bodies)).bodies)
        return [body.factor @ x[..., k, :, :] @ body.factor.T for k, body in enumerate(self.unknowns.bodies)]

    def _numbers(self, code: NumberCode) -> Float[np.ndarray, "*batch n"]:
        found = np.zeros((*self.duals.shape[:-1], self.robot.nv))
        for number, dual in zip(
            self.unknowns.numbers, np.moveaxis(self.duals[..., -len(self.unknowns.numbers) :], -1, 0), strict=True
        ):
            if number.code == code:
                found[..., number.joint] = number.lowest + number.width / (1.0 + np.exp(-dual))
        return found
