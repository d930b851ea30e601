"""What the error of a learned model adds to the inequalities: the corrected Theorem 4 (docs/certificates.md §5)."""

import math
from typing import NamedTuple

import numpy as np

from nbs_pin.accuracy.mismatch import Mismatch
from nbs_pin.base.claims import Claim, Condition, Group
from nbs_pin.certificates.constants import Constants
from nbs_pin.certificates.model_structure import check_fit
from nbs_pin.motions.references import DesiredMotion

_INSTANTS = 2001


class ModelError(NamedTuple):
    """z2ᵀδ ≤ t y + αxy + βy² for ‖δ‖ ≤ a‖q‖ + b‖v‖ + c."""

    t: float
    alpha: float
    beta: float
    lines: tuple[Claim, ...]
    conditions: tuple[Condition, ...]


def model_error(constants: Constants, mismatch: Mismatch, reference: DesiredMotion, duration: float) -> ModelError:
    """The terms of a bound of δ along a reference.

    ‖q‖ ≤ ‖q_d‖ + ‖z1‖ and ‖v‖ ≤ ‖v_d‖ + ‖z2‖ + ‖Λ∇Φ‖, where, with l = √λ_max(Λ) and d = λ_min(D₀),
    ‖z1‖ ≤ lx/ρ, ‖Λ∇Φ‖ ≤ lx and ‖z2‖ ≤ y/√d.
    """
    desired = reference(np.linspace(0.0, duration, _INSTANTS))
    norms = (np.linalg.norm(x, axis=-1) for x in (desired.q, desired.v))
    a, b, c = mismatch.a, mismatch.b, mismatch.c
    k = c + float(np.max(a * next(norms) + b * next(norms)))
    d, root = constants.least_floor, math.sqrt(constants.largest_rate)
    alpha, beta, mu = root * (a / constants.rho + b) / math.sqrt(d), b / d, constants.rho / constants.largest_rate
    fit, along = check_fit(mismatch), f"over {duration:g} s of the reference"
    lines = (
        Claim("a", a, "N·m/rad", fit.label, fit.because, Group.MODEL_ERROR),
        Claim("b", b, "N·m·s/rad", fit.label, fit.because, Group.MODEL_ERROR),
        Claim("c", c, "N·m", fit.label, fit.because, Group.MODEL_ERROR),
        Claim("k = max c + a‖q_d‖ + b‖v_d‖", k, "N·m", fit.label, along, Group.MODEL_ERROR),
    )
    printed = "the paper's sufficient condition, for comparison; it is not what the bounds rest on"
    needed = b + 0.5 * b * b + 0.5 * a + 1.0
    conditions = (
        Condition("Theorem 4: 1 − β > α²/4", 1.0 - beta, 0.25 * alpha**2, "", fit.label, "docs/certificates.md §5"),
        Condition("printed: D > b + b²/2 + a/2 + 1", d, needed, "", fit.label, printed, assumed=False),
        Condition("printed: α > √a", mu, math.sqrt(a), "", fit.label, printed, assumed=False),
    )
    return ModelError(k / math.sqrt(d), alpha, beta, lines, conditions)
