"""A controller as a package of C: what the generator needs of it, and the control steps of its self-test."""

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arguments import writable
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import told
from nbs_pin.base.doors import where_printed
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.base.versions import versions
from nbs_pin.export.adaptation import Adapting
from nbs_pin.export.law import Exported, pid_limit
from nbs_pin.export.package import Steps, write_package
from nbs_pin.export.reals import Precision, Real
from nbs_pin.kernels.layout import JOINTS, LAW, LawCode, Packed
from nbs_pin.kernels.tree_layout import tree_workspace
from nbs_pin.kernels.trees import tree_torques
from nbs_pin.robots.robot import Robot

_PERIOD = 0.001  # of the self-test of a law that has none of its own [s]
_TITLES = {
    LawCode.BACKSTEPPING: "Neural backstepping",
    LawCode.SLOTINE_LI: "Slotine and Li's law",
    LawCode.COMPUTED_TORQUE: "Computed torque",
    LawCode.PD_REFERENCE: "PD with feedforward",
    LawCode.PD_GRAVITY: "PD with gravity",
    LawCode.PID: "PID",
}
STEPS = 1000
"""Control steps of the self-test."""
_TURNS = 3
"""Most whole turns of a continuous joint in the self-test."""
_SPEED = 2.0
"""Largest speed in the self-test of a joint without a limit [rad/s, m/s]."""


class Parts(NamedTuple):
    """What a law consists of in C."""

    law: Packed
    """As `Controller.packed_law` has it; the law inside one that adapts."""
    tree: Packed | None
    """Its model as a rigid tree; None for a PID."""
    robot: Robot | None
    adapting: Adapting | None = None

    @classmethod
    def of(cls, law: Packed, dynamics: Any, robot: Robot | None) -> "Parts":
        """Those of a law without estimates; raises ArgumentError for a model that is no rigid tree."""
        if law.layout[LAW] == LawCode.PID:
            return cls(law, None, robot)
        tree: Packed | None = dynamics.packed_tree()
        if tree is None:
            raise ArgumentError(
                f"the law's model is a {type(dynamics).__name__}, which is no rigid tree and has no C form; export a"
                " law with PinocchioDynamics, IdentifiedDynamics or a learned chain."
            )
        return cls(law, tree, robot)

    def numbers(self) -> list[np.ndarray]:
        """Those of the law, of its model, of what adapts, and of the limits within which the arm moves."""
        robot = self.robot if self.tree is not None else None
        limits = () if robot is None else (robot.lower, robot.upper, robot.velocity_limit)
        adapts = () if self.adapting is None else self.adapting.unknown
        return [*self.law, *(self.tree or ()), *adapts, *limits]


def export_law(
    controller: Any,  # a Controller, whose module imports this one
    folder: Path,
    *,
    precision: Precision,
    gravity: bool,
    rate_limit: JointArray,
    period: float | None,
    certificate: Any,
) -> list[Path]:
    """Write the package of `Controller.export` and return its files; raises ArgumentError for what has no C form."""
    parts, n = controller.parts_in_c(), controller.nv
    law, tree, robot, adapting = parts
    names = tuple(f"joint{i + 1}" for i in range(n))
    if period is None:
        period = _PERIOD if adapting is None else adapting.period
    if tree is None and not gravity:
        given = where_printed(python="gravity=False", shell="--without-gravity")
        raise ArgumentError(f"{given} was given, but a PID has no model whose weight it could leave out; omit it.")
    if rate_limit.shape not in ((), (n,)):
        raise ArgumentError(f"rate_limit has {rate_limit.size} numbers, expected {n}; give one per joint.")
    if certificate is not None:
        _check_certificate(certificate, parts)
    exported = Exported(
        name=_identifier(folder),
        law=law,
        tree=tree,
        adapting=adapting,
        effort_limit=_effort_limit(law, robot),
        rate_limit=np.full(n, rate_limit),
        gravity=gravity,
        real=Real(precision),
        title=_title(parts),
        joint_names=names if robot is None else robot.joint_names,
        prismatic=np.zeros(n, dtype=bool) if robot is None else robot.prismatic,
        robot_sha256="" if robot is None else robot.sha256,
        known=() if certificate is None else _known(certificate),
        versions=versions(),
    )
    writable("export: folder", folder / f"{exported.name}.h")
    return write_package(folder, exported, _steps(controller, robot, exported, period))


def _title(parts: Parts) -> str:
    law, arm = _TITLES[LawCode(parts.law.layout[LAW])], parts.robot
    adapts = "" if parts.adapting is None else " with adaptation"
    return f"{law}{adapts} for {'an arm without a name' if arm is None else arm.name}"


def _effort_limit(law: Packed, robot: Robot | None) -> JointArray:
    """The arm's; of a PID no more than where it saturates, which need not be there."""
    limit = np.full(law.layout[JOINTS], np.inf) if robot is None else robot.effort_limit
    return np.minimum(limit, pid_limit(law)) if law.layout[LAW] == LawCode.PID else limit


def _check_certificate(certificate: Any, parts: Parts) -> None:
    """Raise ArgumentError unless it is a certificate, whose class lies above this module, of this law on this arm."""
    if parts.adapting is not None:
        raise ArgumentError("certificate was given for a law that adapts, of which none is; leave it out.")
    if not (hasattr(certificate, "controller") and callable(getattr(certificate, "summary", None))):
        raise ArgumentError(f"certificate is {told(certificate)}; give a Certificate, as certify returns it.")
    ours, theirs = parts.numbers(), certificate.controller.parts_in_c().numbers()
    same = (np.array_equal(x, y, equal_nan=True) for x, y in zip(ours, theirs, strict=False))
    if len(ours) != len(theirs) or not all(same):
        raise ArgumentError("certificate is for a law or an arm with other numbers; certify the one that is exported.")


def _known(certificate: Any) -> tuple[str, ...]:
    """The numbers of a certificate and what they rest on, line by line."""
    stated = certificate.summary()
    joints = ", ".join(f"{x:.4g} {unit}" for x, unit in zip(stated["joint_errors_rad"], stated["units"], strict=True))
    void = [f"conditions that do not hold: {'; '.join(stated['void'])}"] if stated["void"] else []
    return (
        f"certificate, {stated['label']}, for disturbances {stated['disturbance']}:",
        f"error of all joints at most {stated['error_rad']:.4g} rad, of each at most {joints}",
        *void,
        *(f"assumed: {each['assumption']} ({each['checked']})" for each in stated["assumptions"]),
    )


def _identifier(folder: Path) -> str:
    """What files and functions are called, after the folder: a name of C with an underscore, so no keyword of it."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", folder.absolute().name).strip("_")
    name = name if name[:1].isalpha() else f"law_{name}".rstrip("_")
    return name if "_" in name else f"{name}_law"


def _steps(controller: Any, robot: Robot | None, exported: Exported, period: float) -> Steps:
    given = _states(exported, robot)
    q, v, *aim = given
    memory = controller.initial_memory(q[0])
    if memory is None:
        torque, _ = controller.step(None, q, v, Reference(*aim), period)
    else:
        torque = np.empty_like(q)
        for k in range(len(q)):
            reference = Reference(*(x[k] for x in aim))
            torque[k], memory = controller.step(memory, q[k], v[k], reference, period)
    if exported.tree is not None and not exported.gravity:
        torque = torque - _weight(exported.tree, q)
    return Steps(period, given, torque)


def _weight(tree: Packed, q: Float[np.ndarray, "steps n"]) -> Float[np.ndarray, "steps n"]:
    """G(q) of the model."""
    weight, still = np.empty_like(q), np.zeros_like(q)
    tree_torques(q, still, still, still, *tree, np.empty(tree_workspace(tree)), weight)
    return weight


def _states(exported: Exported, robot: Robot | None) -> Float[np.ndarray, "5 steps n"]:
    """Random states within the limits: errors from small to as large as the range, and whole turns where they wrap."""
    rng, n = np.random.default_rng(0), exported.nv
    low, high, speed = np.full(n, -np.pi), np.full(n, np.pi), np.full(n, _SPEED)
    turns = np.zeros(n)
    if robot is not None:
        (low, high), turns = robot.sampling_range, _TURNS * robot.continuous
        speed = np.where(np.isfinite(robot.velocity_limit), robot.velocity_limit, _SPEED)
    shape, share = (STEPS, n), 10.0 ** rng.uniform(-4.0, 0.0, (STEPS, 1))
    q_ref, v_ref = rng.uniform(low, high, shape), rng.uniform(-speed, speed, shape)
    q = q_ref + share * (rng.uniform(low, high, shape) - q_ref)
    v = v_ref + share * (rng.uniform(-speed, speed, shape) - v_ref)
    q += 2.0 * np.pi * np.rint(rng.uniform(-1.0, 1.0, shape) * turns)
    given = np.stack([q, v, q_ref, v_ref, speed * rng.normal(size=shape)])
    return given.astype(np.float32).astype(float) if exported.real.precision == "float" else given
