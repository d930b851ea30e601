"""Terms that the error of a learned model adds to the inequalities: Theorem 4 corrected (docs/certificates.md §5)."""

import math
from typing import NamedTuple

import numpy as np

from nbs_pin.accuracy.mismatch import Mismatch, violation_chance
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.claims import Claim, Group, Label, refuse
from nbs_pin.certificates.claims import Assumption, Condition, Role
from nbs_pin.certificates.constants import Constants
from nbs_pin.certificates.sampled_motion import SampledMotion
from nbs_pin.motions.references import DesiredMotion


class ModelError(NamedTuple):
    """z2ᵀδ ≤ t y + αxy + βy² for ‖δ‖ ≤ a‖q‖ + b‖v‖ + c."""

    t: float
    alpha: float
    beta: float
    lines: tuple[Claim, ...]
    conditions: tuple[Condition, ...]


def model_error(constants: Constants, mismatch: Mismatch, motion: SampledMotion) -> ModelError:
    """The terms that follow from a bound of δ along a reference.

    ‖q‖ ≤ ‖q_d‖ + ‖z1‖ and ‖v‖ ≤ ‖v_d‖ + ‖z2‖ + ‖Λ∇Φ‖, where, with l = √λ_max(Λ) and d = λ_min(D₀),
    ‖z1‖ ≤ lx/ρ, ‖Λ∇Φ‖ ≤ lx and ‖z2‖ ≤ y/√d.
    """
    a, b, c = mismatch.a, mismatch.b, mismatch.c
    q, v, acceleration = (np.linalg.norm(x, axis=-1) for x in motion.rows)
    between = motion.half * (a * float(v.max()) + b * float(acceleration.max()))
    k = c + float(np.max(a * q + b * v)) + between
    d, root = constants.least_floor, math.sqrt(constants.largest_rate)
    alpha, beta, mu = root * (a / constants.rho + b) / math.sqrt(d), b / d, constants.rho / constants.largest_rate
    fit, along = check_fit(mismatch), f"over {motion.t[-1]:g} s of the reference, between instants too"
    lines = (
        Claim("a", a, "N·m/rad", fit.label, fit.because, Group.MODEL_ERROR),
        Claim("b", b, "N·m·s/rad", fit.label, fit.because, Group.MODEL_ERROR),
        Claim("c", c, "N·m", fit.label, fit.because, Group.MODEL_ERROR),
        Claim("k = max c + a‖q_d‖ + b‖v_d‖", k, "N·m", fit.label, along, Group.MODEL_ERROR),
    )
    printed = "the paper's sufficient condition, for comparison; the bounds do not rest on it"
    needed = b + 0.5 * b * b + 0.5 * a + 1.0
    conditions = (
        Condition("printed: D > b + b²/2 + a/2 + 1", d, needed, "", fit.label, printed, Role.COMPARISON),
        Condition("printed: α > √a", mu, math.sqrt(a), "", fit.label, printed, Role.COMPARISON),
    )
    return ModelError(k / math.sqrt(d), alpha, beta, lines, conditions)


def coverage(
    mismatch: Mismatch,
    reference: DesiredMotion,
    duration: float,
    bound: JointArray,
    errors: JointArray,
    speeds: JointArray,
) -> tuple[Condition, ...]:
    """Whether the trajectories behind a mismatch are like those asked for: reference, length, start and disturbance.

    bound: largest |τ_d,i| that the certificate admits [N·m]. errors, speeds: |q(0) ⊖ q_d(0)| [rad] and |v(0) − v_d(0)|
    [rad/s] of the start.
    """
    m, asked = mismatch, np.asarray(reference(mismatch.t).q)
    same = float(np.abs(m.q_ref - asked).max()) if asked.shape == m.q_ref.shape else math.inf
    rows = [
        ("1e-9 > distance of their reference", 1e-9, same, "rad"),
        ("their length ≥ the certificate's", _padded(m.duration), duration, "s"),
    ]
    pairs = (
        ("their largest start error ≥ that asked for", m.start_errors, errors, "rad"),
        ("their largest start speed ≥ that asked for", m.start_speeds, speeds, "rad/s"),
        ("their largest disturbance ≥ the bound", m.disturbance, bound, "N·m"),
    )
    for name, drawn, wanted, unit in pairs:
        i = int(np.argmax(wanted - drawn))
        rows.append((f"{name}, joint {i + 1}", _padded(float(drawn[i])), float(wanted[i]), unit))
    because = "a scenario statement covers what is drawn alike, nothing else"
    return tuple(
        Condition(f"loops drawn: {name}", left, right, unit, Label.PROVED, because, checks=Assumption.MODEL)
        for name, left, right, unit in rows
    )


def _padded(value: float) -> float:
    return value * (1.0 + 1e-9) + 1e-9


def check_fit(mismatch: Mismatch) -> Claim:
    """The chance ε that a further trajectory breaks ‖δ‖ ≤ a‖q‖ + b‖v‖ + c, recomputed from the trajectories.

    PROBABILISTIC with its β and N; EMPIRICAL if ε ≥ ½, as with few trajectories: the bound then describes its own data
    only. Copies of a trajectory count once.
    Raises CertificateRefused if a constant is negative or not finite, or the data exceed the bound.
    """
    m = mismatch
    constants = np.array([m.a, m.b, m.c])
    if not (np.isfinite(constants).all() and (constants >= 0.0).all() and 0.0 < m.doubt < 1.0):
        refuse(f"the mismatch has a, b, c = {constants.tolist()} and β = {m.doubt}", "fit it again with `mismatch`")
    excess = m.size - m.bound(m.q_norm, m.v_norm)
    if not m.size.size or not bool((excess <= 1e-9 * (1.0 + m.size.max())).all()):
        refuse("the mismatch exceeds the bound a‖q‖ + b‖v‖ + c in its own data", "fit it again with `mismatch`")
    distinct = np.unique(np.concatenate([m.q_norm, m.v_norm, m.size]), axis=1).shape[1]
    count = min(int(m.trajectories), distinct)
    chance = max(violation_chance(count, m.doubt), float(m.violation))
    said = f"{count} independent trajectories, confidence 1 − {m.doubt:g}, for the law, arm and reference they ran with"
    name = "‖δ‖ ≤ a‖q‖ + b‖v‖ + c, chance that a trajectory breaks it"
    if chance < 0.5:
        return Claim(name, chance, "", Label.PROBABILISTIC, f"scenario theorem over {said}")
    because = f"{said}: too few, so the bound describes its own data only; 374 trajectories give 5 %"
    return Claim(name, chance, "", Label.EMPIRICAL, because)
