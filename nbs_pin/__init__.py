"""Tracking control for any URDF arm, stable for every value of its network weights.

Symbols, as in docs/theory.md; q, v, a, tau, nq, nv are Pinocchio's, all SI:

    q, v, a        configuration [rad], velocity [rad/s], acceleration [rad/s²]; one number per joint, nq = nv = n
    tau            joint torque τ [N·m]; tau_d the disturbance τ_d
    M, C, G        M(q)v̇ + C(q, v)v + G(q) = τ + τ_d, with C the Christoffel matrix and G = +∂V/∂q
    z1             tracking error q ⊖ q_d [rad], wrapped on continuous joints
    v_r, a_r       reference velocity φ = v_d − Λ∇Φ(z1) and acceleration φ̇
    z2             v − v_r [rad/s]
    Phi, psi, S    error potential Φ(z1) = z1ᵀS z1 + ψ(z1) [J]
    D, Lambda      damping D(q, z2) [N·m·s/rad] and rate Λ [rad/s per N·m]
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
