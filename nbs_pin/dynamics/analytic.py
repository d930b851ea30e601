"""Dynamics of a planar two-link arm in closed form, the example of the paper."""

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arguments import checked, many, maybe, number
from nbs_pin.base.arrays import Array, Scalars, array_namespace, as_vectors, finite_result
from nbs_pin.base.claims import Claim, Label, refuse
from nbs_pin.base.exceptions import ArgumentError, CertificateRefused
from nbs_pin.base.known_code import known_code
from nbs_pin.base.storable import storable
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.dynamics.structure import POSITIVE, ROUNDING, ModelClaims, quadratic
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.tree_layout import Link, pack_tree
from nbs_pin.robots.robot import ARM, Robot


@known_code
@storable({"masses": "masses", "lengths": "lengths", "gravity": "gravity_constant"}, parts=("robot",), sequence=tuple)
class AnalyticDynamics(DynamicsProvider):
    """Two massless rods of lengths l₁, l₂ [m] with point masses m₁, m₂ [kg] at their ends, gravity g [m/s²].

    V = (m₁ + m₂) g l₁ sin q₁ + m₂ g l₂ sin(q₁ + q₂). Source: paper, section V-A (m = l = 1, g = 9.8, β = q), with the
    sign G = +∂V/∂q and the Christoffel matrix C (docs/theory.md §1). `robot` supplies limits and drawings.

    Raises:
        ArgumentError: If a mass or length is not positive, or a number is not finite.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.bias(nbs.AnalyticDynamics(), q=[0, 0], v=[0, 0])
        array([29.4,  9.8])
    """

    @checked(
        masses=many(number(above=0.0, least=1e-30, most=1e30, unit="kg"), 2, 2, "masses"),
        lengths=many(number(above=0.0, least=1e-30, most=1e30, unit="m"), 2, 2, "lengths"),
        gravity=number(least=-1e30, most=1e30, unit="m/s²"),
        robot=maybe(ARM),
    )
    def __init__(
        self,
        masses: tuple[float, float] = (1.0, 1.0),
        lengths: tuple[float, float] = (1.0, 1.0),
        gravity: float = 9.8,
        robot: Robot | None = None,
    ) -> None:
        (m1, m2), (l1, l2) = masses, lengths
        self._robot, self.masses, self.lengths, self.gravity_constant = robot, masses, lengths, gravity
        self._shoulder = (m1 + m2) * l1 * l1  # inertia of both masses at the elbow about the shoulder
        self._forearm = m2 * l2 * l2
        self._coupling = m2 * l1 * l2
        self._weights = (gravity * (m1 + m2) * l1, gravity * m2 * l2)

    @property
    def nv(self) -> int:
        """Number of joints, 2."""
        return 2

    @property
    def robot(self) -> Robot | None:
        """The arm with these dynamics, if one was given."""
        return self._robot

    def mass_matrix(self, q: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2 2"]:
        """M(q) [kg·m²]."""
        (q,) = as_vectors(2, q=q)
        xp = array_namespace(q)
        coupling = self._coupling * xp.cos(q[..., 1])
        forearm = self._forearm + xp.zeros_like(coupling)
        corner = forearm + coupling
        shoulder = self._shoulder + forearm + 2.0 * coupling
        return xp.stack([xp.stack([shoulder, corner], axis=-1), xp.stack([corner, forearm], axis=-1)], axis=-2)

    def coriolis_matrix(self, q: Float[Array, "*batch 2"], v: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2 2"]:
        """C(q, v) [N·m·s], the Christoffel matrix of M."""
        q, v = as_vectors(2, q=q, v=v)
        xp = array_namespace(q)
        h = self._coupling * xp.sin(q[..., 1])
        v1, v2 = v[..., 0], v[..., 1]
        upper = xp.stack([-h * v2, -h * (v1 + v2)], axis=-1)
        lower = xp.stack([h * v1, 0.0 * h * v1], axis=-1)
        return finite_result("C(q, v)", xp.stack([upper, lower], axis=-2), q, v)

    def gravity(self, q: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """G(q) [N·m]."""
        (q,) = as_vectors(2, q=q)
        xp = array_namespace(q)
        elbow = self._weights[1] * xp.cos(q[..., 0] + q[..., 1])
        return xp.stack([self._weights[0] * xp.cos(q[..., 0]) + elbow, elbow], axis=-1)

    def packed_tree(self) -> Packed | None:
        """Two point masses on joints about z, with gravity along −y; None for a subclass, which may differ."""
        if type(self) is not AnalyticDynamics:
            return None
        (upper, lower), along, z = self.lengths, np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
        links = [
            Link(parent, False, z, np.eye(3), start * along, mass, length * along, np.zeros((3, 3)))
            for parent, start, mass, length in zip((0, 1), (0.0, upper), self.masses, (upper, lower), strict=True)
        ]
        return pack_tree(links, np.array([0.0, -self.gravity_constant, 0.0]))

    def structure_claims(self) -> ModelClaims:
        """λ_min(M) ≥ m₁m₂l₁²l₂² / max trace M; raises CertificateRefused if the attributes are inconsistent."""
        try:
            stated = AnalyticDynamics(self.masses, self.lengths, self.gravity_constant)
        except ArgumentError as error:
            raise CertificateRefused(f"the two-link model is not valid: {error}") from error
        names = ("_shoulder", "_forearm", "_coupling", "_weights")
        if any(getattr(stated, name) != getattr(self, name) for name in names):
            refuse("the equations of the two-link model do not match its masses and lengths", "construct it again")
        (m1, m2), (l1, l2) = self.masses, self.lengths
        trace = (m1 + m2) * l1 * l1 + 2.0 * m2 * l2 * l2 + 2.0 * m2 * l1 * l2
        least = (1.0 - ROUNDING) * m1 * m2 * (l1 * l2) ** 2 / trace
        because = "closed form: least eigenvalue ≥ det M / largest trace"
        return quadratic(Claim(POSITIVE, least, "kg·m²", Label.PROVED, because))

    def potential_energy(self, q: Float[Array, "*batch 2"]) -> Scalars:
        """V(q) [J], zero with the arm horizontal."""
        (q,) = as_vectors(2, q=q)
        xp = array_namespace(q)
        return self._weights[0] * xp.sin(q[..., 0]) + self._weights[1] * xp.sin(q[..., 0] + q[..., 1])
