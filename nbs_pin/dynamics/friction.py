"""Joint friction, for plants and for feedforward in controllers."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arguments import a, check_fields, checked, maybe, number
from nbs_pin.base.arrays import Array, JointArray, Vectors, array_namespace, as_vectors, constant_like
from nbs_pin.base.checks import floats, is_usual, told
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.known_code import known_code
from nbs_pin.base.storable import storable
from nbs_pin.robots.robot import ARM, Robot


@known_code
@storable(("viscous", "coulomb", "transition"))
@dataclass(frozen=True, eq=False)
class JointFriction:
    """Friction torque viscous·v + coulomb·tanh(v / transition) [N·m], opposing the motion.

    The tanh makes Coulomb friction differentiable and suitable for explicit integrators: near v = 0 it is a damper with
    coefficient coulomb / transition, and a step h is stable for h·coulomb / (transition·M) < 2.

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> nbs.JointFriction(viscous=[0.5, 0.2], coulomb=[1.0, 0.0]).torque(np.array([2.0, -1.0]))
        array([ 2. , -0.2])
    """

    viscous: JointArray
    """Viscous coefficient per joint [N·m·s/rad]."""
    coulomb: JointArray
    """Coulomb torque per joint [N·m]."""
    transition: float = 0.01
    """Speed at which 76 % of the Coulomb torque is reached [rad/s]."""

    def __post_init__(self) -> None:
        for name in ("viscous", "coulomb"):
            value = np.atleast_1d(floats(f"JointFriction: {name}", getattr(self, name)))
            if value.ndim != 1 or value.size == 0 or not (is_usual(value) and (value >= 0.0).all()):
                raise ArgumentError(f"{name} friction is {told(value)}; give finite numbers ≥ 0, one per joint.")
            object.__setattr__(self, name, value)
        if self.viscous.shape != self.coulomb.shape:
            raise ArgumentError(
                f"viscous has {self.viscous.size} joints and coulomb {self.coulomb.size}; give one number per joint."
            )
        check_fields(self, transition=number(above=0.0, unit="rad/s"))

    @classmethod
    @checked(robot=ARM)
    def of(cls, robot: Robot, transition: float = 0.01) -> "JointFriction":
        """Friction from the URDF of the robot (`<dynamics damping friction>`), zero where it has none."""
        return cls(robot.damping, robot.friction, transition)

    def torque(self, v: Vectors, tau: Vectors | None = None) -> Vectors:
        """Friction torque [N·m] at the velocity v [rad/s], with the array type of v (numpy or torch).

        The motor torque `tau` [N·m] matters to `DriveFriction` alone.
        """
        (v,) = as_vectors(self.viscous.size, v=v)
        viscous, coulomb = constant_like(v, self.viscous), constant_like(v, self.coulomb)
        return viscous * v + coulomb * array_namespace(v).tanh(v / self.transition)

    def feedforward(self, v: Vectors, needed: Vectors) -> Vectors:
        """What the motor must give at v beyond the torque `needed` [N·m] by the arm without friction [N·m]."""
        return self.torque(v)


@storable(("viscous", "coulomb", "transition", "offset", "asymmetry", "stribeck", "stribeck_speed", "load", "coupling"))
@dataclass(frozen=True, eq=False)
class DriveFriction(JointFriction):
    """Friction of a real drive, and the offset of its torque sensor or current.

        f = offset + viscous·v + asymmetry·|v| + (coulomb + stribeck·exp(−(v/v_s)²) + load·|x|)·tanh(v/transition)

    for the torque x = τ − f that is left for the arm and v_s = stribeck_speed. With a `coupling` N all of this is of
    the motors, which turn with φ̇ = N v: the joints feel Nᵀ f(N v), and motors carry N⁻ᵀ times their torque. A number
    stands for every joint; a Coulomb torque that differs between the directions is an offset. Laws feed it forward, as
    written and not compiled; `certify` and MuJoCo take viscous and Coulomb friction only. Source of the terms: Bona
    and Indri, "Friction compensation in robotics: an overview", CDC 2005.

    Raises:
        ArgumentError: If a number is not finite, one that must be ≥ 0 is negative, or lengths differ.

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> friction = nbs.DriveFriction(viscous=[0.5], coulomb=[1.0], offset=[0.3], load=[0.1])
        >>> v = np.array([2.0])
        >>> friction.feedforward(v, np.array([7.0])), friction.torque(v, tau=np.array([10.0]))
        (array([3.]), array([3.]))
    """

    offset: JointArray = 0.0  # type: ignore[assignment]  # becomes an array
    """Torque at rest that no load explains [N·m]."""
    asymmetry: JointArray = 0.0  # type: ignore[assignment]  # becomes an array
    """Half the difference of the viscous coefficients of both directions [N·m·s/rad]."""
    stribeck: JointArray = 0.0  # type: ignore[assignment]  # becomes an array
    """Coulomb torque beyond `coulomb` at low speed [N·m]."""
    stribeck_speed: JointArray = 0.1  # type: ignore[assignment]
    """Speed at which 1/e of that is left [rad/s]."""
    load: JointArray = 0.0  # type: ignore[assignment]  # becomes an array
    """Coulomb friction as a share, below 1, of the torque that is left for the arm."""
    coupling: Float[np.ndarray, "n n"] | None = None
    """N, invertible; None is the identity."""

    def __post_init__(self) -> None:
        super().__post_init__()
        n = self.viscous.size
        for name in ("offset", "asymmetry", "stribeck", "stribeck_speed", "load"):
            given = floats(f"DriveFriction: {name}", getattr(self, name))
            value = np.full(n, float(given)) if given.ndim == 0 else given
            least = -np.inf if name in ("offset", "asymmetry") else 0.0
            if value.shape != (n,) or not (is_usual(value) and (value >= least).all()):
                kind = "numbers" if least < 0.0 else "numbers ≥ 0"
                raise ArgumentError(f"{name} of the friction is {told(value)}; give {n} finite {kind}, one per joint.")
            object.__setattr__(self, name, value)
        if self.coupling is not None:
            object.__setattr__(self, "coupling", coupling_of(self.coupling, n))
        if not self.stribeck_speed.min() > 0.0:
            raise ArgumentError(f"stribeck_speed is {told(self.stribeck_speed)}; give speeds > 0 [rad/s].")
        if not self.load.max() < 1.0:
            raise ArgumentError(f"load is {told(self.load)}; give shares below 1.")

    def torque(self, v: Vectors, tau: Vectors | None = None) -> Vectors:
        """Friction torque [N·m] at v [rad/s]; without the motor torque `tau` [N·m] it leaves out what depends on loads.

        x = τ − f solves x (1 + load·tanh(v/transition)·sign x) = τ − f₀ for the friction f₀ of no load.
        """
        (v,) = as_vectors(self.viscous.size, v=v)
        loadless, side = self._loadless(self._speeds(v))
        if tau is None:
            return self._of_joints(loadless)
        given = self._of_motors(tau)
        left, share = given - loadless, constant_like(v, self.load) * side
        return self._of_joints(given - left / (1.0 + share * array_namespace(v).sign(left)))

    def feedforward(self, v: Vectors, needed: Vectors) -> Vectors:
        """What the motor must give at v beyond the torque `needed` [N·m] by the arm without friction [N·m]."""
        (v,) = as_vectors(self.viscous.size, v=v)
        loadless, side = self._loadless(self._speeds(v))
        return self._of_joints(loadless + constant_like(v, self.load) * abs(self._of_motors(needed)) * side)

    def _speeds(self, v: Vectors) -> Vectors:
        """N v, of the motors."""
        return v if self.coupling is None else v @ constant_like(v, self.coupling.T)

    def _of_motors(self, tau: Vectors) -> Vectors:
        """N⁻ᵀ τ, for torques of the joints."""
        return tau if self.coupling is None else tau @ constant_like(tau, np.linalg.inv(self.coupling))

    def _of_joints(self, tau: Vectors) -> Vectors:
        """Nᵀ τ, for torques of the motors."""
        return tau if self.coupling is None else tau @ constant_like(tau, self.coupling)

    def _loadless(self, v: Vectors) -> tuple[Vectors, Vectors]:
        """The friction of x = 0, and tanh(v/transition)."""
        xp, of = array_namespace(v), {name: constant_like(v, getattr(self, name)) for name in _OF_DRIVE}
        dry = of["coulomb"] + of["stribeck"] * xp.exp(-((v / of["stribeck_speed"]) ** 2))
        side = xp.tanh(v / self.transition)
        return of["offset"] + of["viscous"] * v + of["asymmetry"] * abs(v) + dry * side, side


_OF_DRIVE = ("viscous", "coulomb", "offset", "asymmetry", "stribeck", "stribeck_speed")
FRICTION = a(JointFriction, "a JointFriction, such as JointFriction.of(robot)")
"""The check of an argument that is joint friction."""


def has_viscous_and_coulomb_only(friction: JointFriction | None) -> bool:
    """Whether these two coefficients are all of the friction, as kernels, certificates and MuJoCo take it."""
    return friction is None or type(friction) is JointFriction


def friction_of_size(friction: JointFriction | None, nv: int) -> JointFriction | None:
    """Return the friction; raise ArgumentError unless it is None or a JointFriction of nv joints."""
    maybe(FRICTION)("friction", friction)
    if friction is not None and friction.viscous.size != nv:
        raise ArgumentError(
            f"the friction is for {friction.viscous.size} joints, the arm has {nv}; give one per joint."
        )
    return friction


def coupling_of(coupling: Float[Array, "n n"], n: int) -> np.ndarray:
    """N as an array; raises ArgumentError unless it is an invertible n×n matrix."""
    matrix = floats("coupling", coupling)
    if matrix.shape != (n, n) or not abs(np.linalg.det(matrix)) > 1e-9:
        raise ArgumentError(
            f"coupling has shape {matrix.shape}, expected an invertible {n}×{n} matrix; row k holds how motor k turns "
            "with every joint."
        )
    return matrix
