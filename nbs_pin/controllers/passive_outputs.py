"""The output of a tracking law in which its loop is passive from a wrong torque: what drives adaptation.

With a wrong torque p̃ added to τ, or for computed torque with a wrong acceleration p̃ added to a_r, V̇ = −(what the law
takes) + sᵀp̃ for

    a law with a Lyapunov function   s = z2
    PD+                              s = ż1 + εz1    V = ½ż1ᵀMż1 + ½z1ᵀK_p z1 + εz1ᵀMż1 + ½εz1ᵀK_d z1
    computed torque                  s = ż1 + λz1    V = ½‖ż1 + λz1‖² + ½z1ᵀ(K_p + λK_d − λ²)z1, λ = ½K_d

For PD+ this holds near the motion alone, as V̇ has the term εz1ᵀCᵀż1, and with gravity alone (PD) near points at rest.
Sources: docs/theory.md §10; Paden and Panja 1988; Takegaki and Arimoto 1981.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arguments import numbers
from nbs_pin.base.arrays import Array, JointArray, constant_like
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.controllers.computed_torque import ComputedTorque
from nbs_pin.controllers.gains import sample_configurations
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.controllers.model_law import ModelLaw
from nbs_pin.controllers.pd import PD
from nbs_pin.kernels.layout import OutputCode


class Output(NamedTuple):
    """Which output a law has."""

    code: OutputCode
    rate: JointArray
    """ε or λ [1/s]; zero for a law with a Lyapunov function."""


class Signals(NamedTuple):
    """What a law adds to the model, τ = M a_r + C v_r + G + feedback, and its output, (..., n)."""

    v_r: Array
    a_r: Array
    output: Array


def output_of(law: ModelLaw, rate: Any = None) -> Output:
    """The output of a law, with this ε or λ; raises ArgumentError for a law of which none is known."""
    code, own = _usual(law)
    given = own if rate is None else np.array(numbers(law.nv, least=0.0, unit="1/s")("output_rate", rate))
    if isinstance(law, LyapunovLaw) and given.any():
        raise ArgumentError(
            f"output_rate is for PD and ComputedTorque, and {type(law).__name__} has none; leave it out."
        )
    if isinstance(law, ComputedTorque) and (given >= law.kd).any():
        raise ArgumentError("output_rate of ComputedTorque is to be below k_d; give a smaller one, or leave it out.")
    return Output(code, given)


def _usual(law: ModelLaw) -> tuple[OutputCode, JointArray]:
    if isinstance(law, LyapunovLaw):
        return OutputCode.VELOCITY, np.zeros(law.nv)
    robot = law.dynamics.robot
    if type(law) is PD and robot is not None:
        root = np.sqrt(law.kd)
        mass = law.dynamics.mass_matrix(sample_configurations(robot)) / (root[:, None] * root)
        slowest = min(1.0 / float(np.linalg.eigvalsh(mass)[:, -1].max()), float((law.kp / law.kd).min()))
        return OutputCode.FILTERED, np.full(law.nv, 0.5 * slowest)
    if type(law) is ComputedTorque:
        return OutputCode.FILTERED, 0.5 * law.kd
    raise ArgumentError(
        f"AdaptiveLaw was given a {type(law).__name__}, of which no passive output is known; give NeuralBackstepping or"
        " another law with a Lyapunov function, PD or ComputedTorque."
    )


def signals_of(law: ModelLaw, output: Output, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Signals:
    """The signals of a law at (..., n) states."""
    if isinstance(law, LyapunovLaw):
        e = law.errors(q, v, q_ref, v_ref, a_ref)
        return Signals(e.v_r, e.a_r - law.inertial_rate * e.z2, e.z2)
    z1, dz1 = law.dynamics.difference(q, q_ref), v - v_ref
    filtered = dz1 + constant_like(q, output.rate) * z1
    if isinstance(law, ComputedTorque):
        kp, kd = law.gains.like(q)
        return Signals(v, a_ref - kd * dz1 - kp * z1, filtered)
    assert isinstance(law, PD)
    share = 0.0 if law.feedforward == "gravity" else 1.0
    return Signals(share * v_ref, share * a_ref, filtered)


def feedback_of(law: ModelLaw, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Array:
    """What a law adds to its model, (..., n) [N·m], of computed torque an acceleration; ωMz2 counts as model."""
    if isinstance(law, LyapunovLaw):
        e = law.errors(q, v, q_ref, v_ref, a_ref)
        return e.gradient + law.damping_force(e.z2)
    assert isinstance(law, PD | ComputedTorque)
    kp, kd = law.gains.like(q)
    return kp * law.dynamics.difference(q, q_ref) + kd * (v - v_ref)


def damping_of(law: ModelLaw, output: Output, mass: Float[np.ndarray, "poses n n"]) -> Float[np.ndarray, "poses n n"]:
    """A matrix Δ with V̇ ≤ −sᵀΔs without a wrong torque, at poses with these mass matrices; of PD near the motion.

    Of PD and computed torque V̇ = −ż1ᵀAż1 − z1ᵀεK_pz1 with A = K_d − εM or K_d − λ, so Δ⁻¹ = A⁻¹ + εK_p⁻¹. Raises
    ArgumentError for an ε or λ with which A is not positive definite.
    """
    if isinstance(law, LyapunovLaw):
        return np.asarray(law.inertial_rate * mass + law.lyapunov().floor)
    assert isinstance(law, PD | ComputedTorque)
    if isinstance(law, ComputedTorque):
        paid = np.broadcast_to(np.diag(law.kd - output.rate), mass.shape)
    else:
        paid = np.diag(law.kd) - 0.5 * (output.rate[:, None] + output.rate) * mass
    if not np.linalg.eigvalsh(paid)[:, 0].min() > 0.0:
        raise ArgumentError(
            f"AdaptiveLaw: the output_rate of {output.rate.max():.3g} 1/s is more than the damping k_d of this"
            f" {type(law).__name__} pays for in every pose; make an AdaptiveLaw around it with a smaller output_rate,"
            " or with none, which then follows from the k_d of now."
        )
    return np.linalg.inv(np.linalg.inv(paid) + np.diag(output.rate / law.kp))
