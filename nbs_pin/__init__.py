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

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_HOMES = {
    "nbs_pin.catalogue": ("ROBOT_NAMES",),
    "nbs_pin.certificates.admissible": ("Admissible",),
    "nbs_pin.certificates.adversary": ("Attack", "attack"),
    "nbs_pin.certificates.certificate": ("Certificate", "certify"),
    "nbs_pin.certificates.design": ("Proposal", "propose"),
    "nbs_pin.certificates.monitor": ("Monitored", "monitor"),
    "nbs_pin.certificates.watch": ("Watch",),
    "nbs_pin.checkpoints": ("load", "save"),
    "nbs_pin.controllers.computed_torque": ("ComputedTorque",),
    "nbs_pin.controllers.controller": ("Controller", "MemorylessController"),
    "nbs_pin.controllers.neural_backstepping": ("NeuralBackstepping", "paper_controller"),
    "nbs_pin.controllers.pd": ("PD",),
    "nbs_pin.controllers.pid": ("PID",),
    "nbs_pin.controllers.slotine_li": ("SlotineLi",),
    "nbs_pin.disturbances": ("ConstantTorque", "SinusoidalTorque", "SquareWave", "TorqueNoise"),
    "nbs_pin.dynamics.analytic": ("AnalyticDynamics",),
    "nbs_pin.dynamics.equations": (
        "bias",
        "energy",
        "forward_dynamics",
        "inverse_dynamics",
        "kinetic_energy",
        "reference_torque",
    ),
    "nbs_pin.dynamics.friction": ("JointFriction",),
    "nbs_pin.dynamics.identified": ("IdentifiedDynamics",),
    "nbs_pin.dynamics.lagrangian": ("LagrangianDynamics",),
    "nbs_pin.dynamics.pinocchio": ("PinocchioDynamics",),
    "nbs_pin.dynamics.provider": ("DynamicsProvider",),
    "nbs_pin.dynamics.residual": ("ResidualDynamics",),
    "nbs_pin.exceptions": ("NbsPinError",),
    "nbs_pin.learning.costs": ("TimeOutside", "TorqueAware", "squared_error"),
    "nbs_pin.learning.datasets": ("Dataset", "load_dataset"),
    "nbs_pin.learning.fitting": ("fit",),
    "nbs_pin.learning.identification": ("identify",),
    "nbs_pin.learning.logs": ("load_log",),
    "nbs_pin.learning.measuring": ("Noise",),
    "nbs_pin.learning.recipes": ("collect",),
    "nbs_pin.learning.training": ("Training", "train"),
    "nbs_pin.model_error": ("ModelErrors", "compare"),
    "nbs_pin.networks.damping": ("Damping",),
    "nbs_pin.networks.potential": ("Potential",),
    "nbs_pin.plants.dynamics_plant": ("DynamicsPlant",),
    "nbs_pin.plants.mujoco_plant": ("MujocoPlant",),
    "nbs_pin.plants.plant": ("Plant",),
    "nbs_pin.plotting": ("plot_tracking",),
    "nbs_pin.reference_files": ("Sampled", "load_reference"),
    "nbs_pin.references": ("Hold", "MinimumJerk", "Sinusoid", "check_reference", "paper_reference"),
    "nbs_pin.replay_page": ("replay",),
    "nbs_pin.robot": ("Robot", "load_robot"),
    "nbs_pin.simulation": ("simulate", "stream"),
    "nbs_pin.state": ("Reference", "Run"),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = ["__version__", "metrics", *sorted(_HOME_OF)]


def __getattr__(name: str) -> Any:
    """A public name, imported from its room at first use: `import nbs_pin` stays light."""
    if name == "metrics":
        return import_module("nbs_pin.metrics")
    if name not in _HOME_OF:
        raise AttributeError(f"module 'nbs_pin' has no attribute '{name}'")
    return getattr(import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
