"""The equations of motion of any `DynamicsProvider`, with checks of the shapes (docs/theory.md §1)."""

from nbs_pin.base.arguments import checked
from nbs_pin.base.arrays import Array, Scalars, Vectors, array_namespace, as_vectors, finite_result, matvec
from nbs_pin.dynamics.provider import MODEL, DynamicsProvider


@checked(dynamics=MODEL)
def reference_torque(dynamics: DynamicsProvider, q: Array, v: Array, v_r: Array, a_r: Array) -> Vectors:
    """M(q) a_r + C(q, v) v_r + G(q) [N·m], for a reference velocity v_r [rad/s] and acceleration a_r [rad/s²].

    Raises:
        ArgumentError: If a shape is not (..., nv).

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.reference_torque(nbs.AnalyticDynamics(), q=[0, 0], v=[0, 0], v_r=[0, 0], a_r=[1, 0])
        array([34.4, 11.8])
    """
    return dynamics.reference_torque(*as_vectors(dynamics.nv, q=q, v=v, v_r=v_r, a_r=a_r))


@checked(dynamics=MODEL)
def inverse_dynamics(dynamics: DynamicsProvider, q: Array, v: Array, a: Array) -> Vectors:
    """τ = M(q) a + C(q, v) v + G(q) [N·m], the torque that produces the acceleration a [rad/s²].

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.inverse_dynamics(nbs.AnalyticDynamics(), q=[0, 0], v=[0, 0], a=[-9.8, 9.8])
        array([0., 0.])
    """
    q, v, a = as_vectors(dynamics.nv, q=q, v=v, a=a)
    return dynamics.reference_torque(q, v, v, a)


@checked(dynamics=MODEL)
def forward_dynamics(dynamics: DynamicsProvider, q: Array, v: Array, tau: Array) -> Vectors:
    """v̇ = M(q)⁻¹(τ − C(q, v) v − G(q)) [rad/s²], the acceleration produced by the torque τ [N·m].

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.forward_dynamics(nbs.AnalyticDynamics(), q=[0, 0], v=[0, 0], tau=[0, 0])
        array([-9.8,  9.8])
    """
    return dynamics.forward_dynamics(*as_vectors(dynamics.nv, q=q, v=v, tau=tau))


@checked(dynamics=MODEL)
def bias(dynamics: DynamicsProvider, q: Array, v: Array) -> Vectors:
    """C(q, v) v + G(q) [N·m]: the torque that keeps the velocity constant.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.bias(nbs.AnalyticDynamics(), q=[0.0, 0.0], v=[0.0, 0.0])  # two links held level
        array([29.4,  9.8])
    """
    q, v = as_vectors(dynamics.nv, q=q, v=v)
    return dynamics.reference_torque(q, v, v, 0.0 * v)


@checked(dynamics=MODEL)
def kinetic_energy(dynamics: DynamicsProvider, q: Array, v: Array) -> Scalars:
    """½ vᵀM(q)v [J].

    Example:
        >>> import nbs_pin as nbs
        >>> float(nbs.kinetic_energy(nbs.AnalyticDynamics(), q=[0.0, 0.0], v=[1.0, 0.0]))  # 1 kg at 1 m and at 2 m
        2.5
    """
    q, v = as_vectors(dynamics.nv, q=q, v=v)
    value = 0.5 * array_namespace(v).sum(v * matvec(dynamics.mass_matrix(q), v), axis=-1)
    return finite_result("the kinetic energy", value, q, v)


@checked(dynamics=MODEL)
def energy(dynamics: DynamicsProvider, q: Array, v: Array) -> Scalars:
    """E = ½ vᵀM(q)v + V(q) [J]; dE/dt = vᵀτ along every motion.

    Example:
        >>> import nbs_pin as nbs
        >>> dynamics = nbs.AnalyticDynamics()
        >>> float(nbs.energy(dynamics, q=[0.0, 0.0], v=[1.0, 0.0]) - dynamics.potential_energy([0.0, 0.0]))
        2.5
    """
    q, v = as_vectors(dynamics.nv, q=q, v=v)
    return kinetic_energy(dynamics, q, v) + dynamics.potential_energy(q)
