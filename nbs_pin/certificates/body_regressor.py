"""Torque, inertia and Christoffel matrices of errors of the bodies, from Pinocchio's regressor of their parameters."""

import numpy as np
import pinocchio as pin

from nbs_pin.base.arrays import JointArray
from nbs_pin.certificates.uncertainty import BodyErrors
from nbs_pin.robots.robot import Robot


class BodyRegressor:
    """All errors of the bodies of a model at once; results have one column or matrix per error."""

    def __init__(self, robot: Robot, model: pin.Model, errors: BodyErrors) -> None:
        self.slides = robot.prismatic
        self._model, self._data = model, model.createData()
        self._weightless = model.copy()
        self._weightless.gravity = pin.Motion.Zero()
        self._columns = np.zeros((10 * model.nv, len(errors.body)))
        for g, (body, row) in enumerate(zip(errors.body.tolist(), errors.parameters, strict=True)):
            self._columns[10 * body : 10 * body + 10, g] = row
        self._unit, self._zero = np.eye(model.nv), np.zeros(model.nv)

    def at(self, q: JointArray, v: JointArray, a: JointArray) -> tuple[np.ndarray, ...]:
        """w = ΔM a + ΔC(q, v)v + ΔG (n, g), and ∂w/∂q, ΔM and ΔC(q, v), each (g, n, n).

        With h(x) = C(q, x)x, C(q, v)e = ¼(h(v + e) − h(v − e)), as C(q, v)e is symmetric in v and e.
        """
        zero = self._zero
        slope = [self._derivative(q, v, a, e, slides) for e, slides in zip(self._unit, self.slides, strict=True)]
        mass = [self._free(q, zero, e) for e in self._unit]
        coriolis = [0.25 * (self._free(q, v + e, zero) - self._free(q, v - e, zero)) for e in self._unit]
        torque = self._full(q, v, a) @ self._columns
        return torque, *((np.array(x) @ self._columns).transpose(2, 1, 0) for x in (slope, mass, coriolis))

    def _derivative(self, q: JointArray, v: JointArray, a: JointArray, e: JointArray, slides: bool) -> np.ndarray:
        """∂/∂q_l of the regressor, exactly: it is a trigonometric polynomial of degree ≤ 2 in the angle of a joint that
        turns, and a polynomial of degree ≤ 2 in the travel of one that slides.
        """

        def half_difference(step: JointArray) -> np.ndarray:
            return np.asarray(0.5 * (self._full(q + step, v, a) - self._full(q - step, v, a)))

        if slides:
            return half_difference(e)
        return 2.0 * half_difference(0.25 * np.pi * e) + (1.0 - np.sqrt(2.0)) * half_difference(0.5 * np.pi * e)

    def _full(self, q: JointArray, v: JointArray, a: JointArray) -> np.ndarray:
        return np.array(pin.computeJointTorqueRegressor(self._model, self._data, q, v, a))

    def _free(self, q: JointArray, v: JointArray, a: JointArray) -> np.ndarray:
        return np.array(pin.computeJointTorqueRegressor(self._weightless, self._data, q, v, a))
