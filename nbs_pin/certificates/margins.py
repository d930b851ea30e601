"""Conditions that a certificate in continuous time does not include: sampling, delay, torque and position limits."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.claims import Claim, Group, Label, refuse
from nbs_pin.base.records import Reference
from nbs_pin.base.units import units
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.claims import Assumption, Condition, Role
from nbs_pin.certificates.constants import configurations
from nbs_pin.certificates.sampled_motion import SampledMotion
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.dynamics.equations import inverse_dynamics
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.robots.robot import Robot

_RULE = "a rule that separated calm from chatter in 52 runs of a panda (docs/theory.md §5), at sampled states"
_DIRECTIONS = 1000
STIFF = 0.4
"""Largest √λ_max(M⁻¹K)h at which sampled loops without delay stay calm (measured, docs/theory.md §2)."""
_SHARE = 0.5
"""Share of the longest control period by the rule that a certificate accepts."""


def sampled_control(
    controller: LyapunovLaw, period: float | None, storage: float = 0.0, potential: float = 0.0
) -> tuple[tuple[Claim, ...], tuple[Condition, ...]]:
    """The longest hold and delay by the two rules of sampled control [s], and conditions for a period.

    The period must stay below half of the first, and below STIFF/√λ_max(M⁻¹K) for the stiffness K of the law.

    h < 2/(λ_max(M⁻¹D) + λ_max(Λ∇²Φ)) and delay < (π/2)/λ_max(M⁻¹D), with D including its inertial part ωM, at the
    largest values on sampled states with W ≤ `storage` and Φ ≤ `potential` [J].
    """
    speed, error_speed, stiffness = _speeds(controller, storage, potential)
    hold, delay = 2.0 / (speed + error_speed), 0.5 * np.pi / speed
    lines = (
        Claim("longest control period", hold, "s", Label.EMPIRICAL, _RULE, Group.SAMPLED),
        Claim("longest delay", delay, "s", Label.EMPIRICAL, _RULE, Group.SAMPLED),
    )
    if period is None:
        return lines, ()
    name, left = "control period: 1/(λ_max(M⁻¹D) + λ_max(Λ∇²Φ)) > h", _SHARE * hold
    because = f"half the period of {_RULE}"
    found = Condition(name, left, period, "s", Label.EMPIRICAL, because, Role.NECESSARY, Assumption.TIME)
    name, right = f"{STIFF:g} > √λ_max(M⁻¹K) h, with the stiffness K = (ζ + DΛ)∇²Φ", math.sqrt(stiffness) * period
    stiff = Condition(name, STIFF, right, "", Label.EMPIRICAL, _RULE, Role.NECESSARY, Assumption.TIME)
    return lines, (found, stiff)


def _speeds(controller: LyapunovLaw, storage: float, potential: float) -> tuple[float, float, float]:
    """The largest λ_max(M⁻¹D) + ω, λ_max(Λ∇²Φ) [1/s] and λ_max(M⁻¹(ζ∇²Φ + D₀Λ∇²Φ)) + ωλ_max(Λ∇²Φ) [1/s²].

    They are of sampled states of the sets, the centres included.
    """
    n, rng = controller.nv, np.random.default_rng(0)
    root = np.linalg.cholesky(controller.dynamics.mass_matrix(configurations(controller.dynamics)))
    z2 = math.sqrt(2.0 * storage) * np.linalg.solve(root.mT, _in_ball(rng, len(root), n)[..., None])[..., 0]
    speed = 0.0
    for damping in (controller.damping_matrix(np.zeros(n)), controller.damping_matrix(z2)):
        half = np.linalg.solve(root, np.broadcast_to(damping, root.shape))
        scaled = np.linalg.solve(root, half.mT)
        speed = max(speed, float(np.linalg.eigvalsh(0.5 * (scaled + scaled.mT))[:, -1].max()))
    shape = np.linalg.cholesky(controller.lyapunov().stiffness)
    z1 = math.sqrt(potential) * np.linalg.solve(shape.T, _in_ball(rng, _DIRECTIONS, n).T).T
    z1 = np.concatenate([np.zeros((1, n)), z1])
    columns = np.broadcast_to(np.eye(n), (len(z1), n, n))
    curvature = controller.potential_terms(np.repeat(z1[:, None], n, axis=1), columns)[2]
    rate = np.sqrt(controller.rate_like(np.zeros(n)))
    scaled = rate[:, None] * curvature * rate
    error_speed = float(np.linalg.eigvalsh(0.5 * (scaled + scaled.mT))[:, -1].max())
    damping = np.broadcast_to(controller.damping_matrix(np.zeros(n)), (n, n))
    force = controller.coupling * curvature + damping @ (rate[:, None] ** 2 * curvature)
    pairs = np.linalg.solve((root @ root.mT)[: len(z1)], force[: len(root)])
    stiffness = float(np.abs(np.linalg.eigvals(pairs)).max()) + controller.inertial_rate * error_speed
    return controller.inertial_rate + speed, error_speed, stiffness


def _in_ball(rng: np.random.Generator, count: int, n: int) -> Float[np.ndarray, "count n"]:
    """Points of the unit ball, every second one on its surface."""
    points = rng.standard_normal((count, n))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points[1::2] *= rng.uniform(0.0, 1.0, (len(points[1::2]), 1))
    return np.asarray(points)


def effort_margin(
    robot: Robot,
    dynamics: DynamicsProvider,
    admissible: Admissible,
    motion: SampledMotion,
    frictions: Sequence[JointFriction | None] = (None,),
) -> tuple[Condition, ...]:
    """Whether every effort limit exceeds the torque of the reference, with any friction, plus the disturbance [N·m].

    The condition is that of the joint with the least margin. Feedback adds a torque that depends on the motion.
    """
    if not np.isfinite(robot.effort_limit).any():
        return ()
    torque = inverse_dynamics(dynamics, *motion.rows)
    all_torques = [torque if friction is None else torque + friction.torque(motion.v) for friction in frictions]
    needed = np.abs(all_torques).max(axis=(0, 1))
    bound = admissible.largest(robot.nv)
    because = f"reference over {motion.t[-1]:g} s; necessary, not sufficient: feedback comes on top"
    return (least_room(robot, "effort", needed + bound, "torque of reference and disturbance", because),)


def unsaturated(robot: Robot, law: LyapunovLaw, motion: SampledMotion, room: JointArray) -> tuple[Condition, ...]:
    """Whether every effort limit exceeds the torque of the reference and how far the law's torque may be from it [N·m].

    If so, no torque is ever cut off, which proves the assumption; if not, it stays one, and the condition is a
    comparison that names the joint.
    """
    if not (np.isfinite(robot.effort_limit).any() and np.isfinite(room).all()):
        return ()
    torque = inverse_dynamics(law.dynamics, *motion.rows)
    if law.friction is not None:
        torque = torque + law.friction.torque(motion.v)
    because = f"reference over {motion.t[-1]:g} s, and every state of the bounds: docs/certificates.md §15"
    found = least_room(robot, "effort", np.abs(torque).max(axis=0) + room, "largest torque of the law", because)
    return (replace(found, role=Role.SUFFICIENT if found.holds else Role.COMPARISON),)


def start_margin(
    robot: Robot, controller: LyapunovLaw, start: tuple[JointArray, JointArray], begin: Reference
) -> tuple[Condition, ...]:
    """Whether every effort limit exceeds the torque of the law at the given start [N·m], for the least margin."""
    if not np.isfinite(robot.effort_limit).any():
        return ()
    torque, here = np.abs(controller.torque(*start, *begin)), "the law evaluated there"
    return (least_room(robot, "effort", torque, "torque at the start", here),)


def hold_margin(
    controller: LyapunovLaw, metric: Float[np.ndarray, "n n"], motion: SampledMotion, period: float, energy: float
) -> tuple[Condition, ...]:
    """Whether the disturbance exceeds what half a hold changes of the reference's torque, as τᵀD₀⁻¹τ [W].

    metric: D₀⁻¹. energy: sup τ_dᵀD₀⁻¹τ_d. Errors add a change of their own.
    """
    torque = inverse_dynamics(controller.dynamics, *motion.rows)
    change = 0.5 * period * np.diff(torque, axis=0) / np.diff(motion.t)[:, None]
    size = float(np.einsum("ti,ij,tj->t", change, metric, change).max())
    if size == 0.0:
        return ()
    name = "sup τ_dᵀD₀⁻¹τ_d > that of what half a hold changes of the reference's torque"
    because = "the torque is held for a period; a rule: the errors change it too"
    return (Condition(name, energy, size, "W", Label.EMPIRICAL, because, Role.NECESSARY, Assumption.TIME),)


def velocity_margin(robot: Robot, motion: SampledMotion, start: JointArray | float = 0.0) -> tuple[Condition, ...]:
    """Whether every velocity limit exceeds the speed of reference and start [rad/s], for the least margin."""
    if not np.isfinite(robot.velocity_limit).any():
        return ()
    because = f"reference over {motion.t[-1]:g} s; necessary, not sufficient: the error adds a speed"
    needed = np.maximum(motion.speed, np.abs(start))
    return (least_room(robot, "velocity", needed, "speed of reference and start", because),)


def least_room(robot: Robot, kind: str, needed: JointArray, what: str, because: str) -> Condition:
    """The necessary condition limit > needed of the joint whose limit is exceeded most, relative to it."""
    limit = robot.effort_limit if kind == "effort" else robot.velocity_limit
    share = np.divide(needed, limit, out=np.zeros_like(limit), where=np.isfinite(limit))
    worst = int(np.argmax(share))
    unit = units("torque" if kind == "effort" else kind, robot.prismatic)[worst]
    checks = Assumption.EFFORT if kind == "effort" else Assumption.VELOCITY
    name = f"{kind} limit of {robot.joint_names[worst]} > {what}"
    sides = float(limit[worst]), float(needed[worst])
    return Condition(name, *sides, unit, Label.PROVED, because, Role.NECESSARY, checks)


def position_margin(robot: Robot, errors: JointArray, motion: SampledMotion) -> tuple[Condition, ...]:
    """Whether the reference with its errors stays inside the position limits, for the joint with the least margin.

    Between two instants no joint of the reference is farther than ½Δt·max|v_d| from one of them.
    Raises CertificateRefused if the reference alone leaves the limits.
    """
    check_box(motion.q, robot.lower, robot.upper)
    left = np.minimum(motion.q - robot.lower, robot.upper - motion.q).min(axis=0) - motion.half * motion.speed
    joint = int(np.argmin(left - errors))
    if not np.isfinite(left[joint]):
        return ()
    name, because = f"room of {robot.joint_names[joint]} to its position limits > |z1_i|", f"over {motion.t[-1]:g} s"
    sides, unit = (float(left[joint]), float(errors[joint])), units("position", robot.prismatic)[joint]
    return (Condition(name, *sides, unit, Label.PROVED, because, checks=Assumption.STOPS),)


def smoothness(motion: SampledMotion) -> tuple[Condition, ...]:
    """Whether the reference moves as its own derivatives say, at the instant where it does so least."""
    rest, allowed, t, joint = motion.contradiction()
    name = f"reference: allowed > change of joint {joint + 1} at t = {t:.4g} s that its derivatives do not explain"
    because = f"{len(motion.t)} instants; nothing is checked between them"
    return (Condition(name, allowed, rest, "", Label.EMPIRICAL, because, Role.NECESSARY, Assumption.REFERENCE),)


def check_box(
    positions: Float[np.ndarray, "rows n"],
    low: JointArray,
    high: JointArray,
    *,
    error: JointArray | float = 0.0,
    box: str = "the joint limits",
) -> Claim:
    """The least distance of the reference with its error to a side of a box [rad, m], over the given rows.

    positions: of the reference. low, high: sides of the box, ∓inf for none. error: bound of |z1_i|. box: its name in
    messages. The claim is EMPIRICAL, as nothing is checked between the rows.
    Raises CertificateRefused if the reference with its error leaves the box, or a number is NaN.
    """
    inside = np.minimum(positions - low, high - positions) - error
    if not positions.size or np.isnan(inside).any():
        refuse(f"the reference or {box} is empty or contains NaN", "give finite positions and sides")
    margin, joint = float(inside.min()), int(inside.min(axis=0).argmin())
    if margin < 0.0:
        refuse(
            f"the reference with its error leaves {box} at joint {joint + 1} by {-margin:.3g}",
            "give a larger box or a smaller motion",
        )
    because = f"least over {len(positions)} instants and all joints; nothing is checked between the instants"
    return Claim(f"reference inside {box}, least margin", margin, "rad", Label.EMPIRICAL, because)
