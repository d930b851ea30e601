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
    "nbs_pin.robots.catalogue": ("ROBOT_NAMES",),
    "nbs_pin.certificates.admissible": ("Admissible",),
    "nbs_pin.certificates.attack": ("Attack", "attack"),
    "nbs_pin.certificates.certify": ("Certificate", "certify"),
    "nbs_pin.certificates.propose": ("Proposal", "propose"),
    "nbs_pin.certificates.monitor": ("Monitored", "monitor"),
    "nbs_pin.certificates.online_monitor": ("Watch",),
    "nbs_pin.storage.checkpoints": ("load", "save"),
    "nbs_pin.controllers.computed_torque": ("ComputedTorque",),
    "nbs_pin.controllers.controller": ("Controller", "MemorylessController"),
    "nbs_pin.controllers.neural_backstepping": ("NeuralBackstepping", "paper_controller"),
    "nbs_pin.controllers.pd": ("PD",),
    "nbs_pin.controllers.pid": ("PID",),
    "nbs_pin.controllers.slotine_li": ("SlotineLi",),
    "nbs_pin.motions.disturbances": ("ConstantTorque", "SinusoidalTorque", "SquareWave", "TorqueNoise"),
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
    "nbs_pin.base.exceptions": ("NbsPinError",),
    "nbs_pin.simulation.costs": ("TimeOutside", "TorqueAware", "squared_error"),
    "nbs_pin.identification.datasets": ("Dataset", "load_dataset"),
    "nbs_pin.identification.fit": ("fit",),
    "nbs_pin.identification.identify": ("identify",),
    "nbs_pin.identification.logs": ("load_log",),
    "nbs_pin.identification.measurement": ("Noise",),
    "nbs_pin.identification.collect": ("collect",),
    "nbs_pin.training.train": ("Training", "train"),
    "nbs_pin.accuracy.compare": ("ModelErrors", "compare"),
    "nbs_pin.controllers.damping": ("Damping",),
    "nbs_pin.controllers.potential": ("Potential",),
    "nbs_pin.simulation.dynamics_plant": ("DynamicsPlant",),
    "nbs_pin.simulation.mujoco_plant": ("MujocoPlant",),
    "nbs_pin.simulation.plant": ("Plant",),
    "nbs_pin.reports.plotting": ("plot_tracking",),
    "nbs_pin.motions.reference_files": ("Sampled", "load_reference"),
    "nbs_pin.motions.references": ("Hold", "MinimumJerk", "Sinusoid", "check_reference", "paper_reference"),
    "nbs_pin.reports.replay": ("replay",),
    "nbs_pin.robots.robot": ("Robot", "load_robot"),
    "nbs_pin.simulation.simulate": ("simulate", "stream"),
    "nbs_pin.base.records": ("Reference", "Run"),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = ["__version__", "metrics", *sorted(_HOME_OF)]


def __getattr__(name: str) -> Any:
    """A public name, imported from its room at first use: `import nbs_pin` stays light."""
    if name == "metrics":
        return import_module("nbs_pin.simulation.metrics")
    if name not in _HOME_OF:
        raise AttributeError(f"module 'nbs_pin' has no attribute '{name}'")
    return getattr(import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
