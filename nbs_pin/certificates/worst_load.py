"""The load that an adaptive law knows least of: the largest Fermi–Dirac divergence over all loads of a box.

d(X‖X₀) = F(X) + F*(Q₀) − tr Q₀X is convex in the load, so it is largest for no load or for a point mass of the largest
mass, X(x) = A + m̄ B w wᵀBᵀ with w = (x, 1), ‖x‖ ≤ r (docs/certificates.md §16). The ball of x is searched by branch and
bound, with a bound over every cell.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import Scalars
from nbs_pin.base.claims import refuse
from nbs_pin.base.rounding import up
from nbs_pin.controllers.unknowns import UnknownBody, UnknownNumber
from nbs_pin.kernels.symmetric4 import FARTHEST

_GAP = 0.02
"""Share by which the bound may be above the largest divergence."""
_MOST_CELLS, _FINEST = 200_000, 1e-6  # where the search ends with a wider gap; cells as a share of the radius
_LIKELY, _PRICES = 64, 12  # cells in which a worse load is looked for; multipliers μ that are tried
_ALLOWANCE = 64.0 * np.finfo(float).eps
_TINY, _SHARE = 1e-12, 1e-3  # where φ becomes its tangent: what is lost, at least, and as a share of the divergence
_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


class WorstLoad(NamedTuple):
    """The load of the largest divergence that was found, and a bound for all."""

    bound: float
    """d(X‖X₀) is at most this for every load of the box."""
    found: float
    """d(X‖X₀) of the worst load found."""
    mass: float
    """Its mass [kg], 0 or the largest one."""
    centre: Float[np.ndarray, "3"]
    """Its place in the frame that carries the load [m]."""


class Divergence:
    """d(X‖X₀) of one body, X = K⁻¹PK⁻ᵀ."""

    def __init__(self, body: UnknownBody) -> None:
        self.body, self.dual = body, body.start
        self.inverse = np.linalg.inv(body.factor)
        self.carrier = self.inverse @ body.place
        self.conjugate = float(np.logaddexp(0.0, np.linalg.eigvalsh(body.start)).sum())
        self.rounding = _ALLOWANCE * float(np.linalg.cond(body.factor)) ** 2

    def known(self) -> Float[np.ndarray, "4 4"]:
        """X of the body that the model has."""
        return self._symmetric(self.inverse @ self.body.known @ self.inverse.T)

    def loaded(self, mass: float, at: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 4 4"]:
        """X with a point mass [kg] at these places in the frame that carries the load [m]."""
        u = at @ self.carrier[:, :3].T + self.carrier[:, 3]
        return self.known() + mass * u[..., :, None] * u[..., None, :]

    def value(self, x: Float[np.ndarray, "*batch 4 4"], bend: float = _TINY) -> Scalars:
        """d(X‖X₀), with φ(λ) = λ log λ + (1 − λ) log(1 − λ) continued by its tangents from `bend` and 1 − `bend` on.

        This is convex for every symmetric X, and for 0 ⪯ X ⪯ 1 less than d by 4 log 1/(1 − bend) at most.
        """
        values = np.linalg.eigvalsh(x)
        inside = np.clip(values, bend, 1.0 - bend)
        rest = np.log1p(-inside)
        slope = np.log(inside) - rest
        entropy = (inside * slope + rest + slope * (values - inside)).sum(axis=-1)
        return np.asarray(entropy + self.conjugate - (self.dual * x).sum(axis=(-2, -1)))

    def margin(self, bend: float) -> float:
        """What `value` can be too small by: its tangents, and rounding errors of X by the slopes of φ and of tr Q₀X."""
        slope = math.log1p(-bend) - math.log(bend) + float(np.abs(np.linalg.eigvalsh(self.dual)).max())
        return 4.0 * (slope * self.rounding - math.log1p(-bend))

    def at_known(self) -> float:
        """A bound of d of the body that the model has: 0 but for rounding errors, unless its first estimate was cut.

        Raises CertificateRefused for a body that cannot exist.
        """
        values = np.linalg.eigvalsh(self.known())
        inside, slack = np.clip(values, 0.0, 1.0), 1e-9 + self.rounding
        if not np.abs(values - inside).max() <= slack:
            refuse(
                f"the model's body of {self.body.name} cannot exist or is above the largest one, as its shares are "
                f"{np.round(values, 9).tolist()}",
                "correct the model",
            )
        exact = np.abs(self.body.start - self._dual_of(self.known())).max() <= 1e-6
        return 0.0 if exact else up(float(self.value(self.known())) + self.margin(_TINY))

    def worst(self, mass: float, radius: float) -> WorstLoad:
        """Over all loads of at most this mass [kg] within this radius of the frame [m].

        Raises CertificateRefused for loads that are not below the largest body.
        """
        spread = self.carrier @ np.diag([radius**2] * 3 + [1.0]) @ self.carrier.T
        most = self.known() + 2.0 * mass * self._symmetric(spread)
        if not np.linalg.eigvalsh(most)[-1] <= 1.0 + 1e-9 + self.rounding:
            refuse(
                f"loads up to {mass:g} kg within {radius:g} m are beyond the largest body of {self.body.name}",
                "give a law with a larger load_mass or load_radius",
            )
        begin, centre = self.at_known(), np.zeros(3)
        found = float(self._found(mass, centre[None])[0])
        bound = found + self.margin(_TINY)
        if radius > 0.0:
            bound, found, centre = self._searched(mass, radius, max(found, begin))
        bound = up(max(bound, begin))
        return WorstLoad(bound, found, mass, centre) if found >= begin else WorstLoad(bound, begin, 0.0, np.zeros(3))

    def _searched(self, mass: float, radius: float, least: float) -> tuple[float, float, Float[np.ndarray, "3"]]:
        """A bound over the ball, the largest value found, and where.

        In a cell c ± ρ, x is the mean of the corners v with independent weights, and X(x) that of their X less
        E = m̄ Σ e_i b_ib_iᵀ, 0 ≤ e_i ≤ ρ², b_i the columns of B. So d(X(x)‖X₀) is at most the mean of its values at the
        corners, with φ continued, and ρ²m̄ Σ max(0, L‖b_i‖² + b_iᵀQ₀b_i), L the largest slope of φ. As the mean of
        ‖v‖² is at most r² + 3ρ² where ‖x‖ ≤ r, that mean is at most the largest d − μ(‖v‖² − r² − 3ρ²), any μ ≥ 0.
        """
        bend = min(max(_SHARE * least, _TINY), 1e-4)
        margin = self.margin(bend)
        centres, half, place, best = np.zeros((1, 3)), radius, np.zeros(3), -math.inf
        while True:
            corners = centres[:, None] + half * _CORNERS
            uppers = self.above(mass, radius, corners, half, bend)
            likely = corners[np.argsort(uppers)[-_LIKELY:]].reshape(-1, 3)
            likely = likely * (radius / np.maximum(np.linalg.norm(likely, axis=-1), radius))[:, None]
            found = self._found(mass, likely)
            if found.max() > best:
                best, place = float(found.max()), likely[int(found.argmax())]
            enough = max(best, least) * (1.0 + _GAP) + margin
            still = ~(uppers <= enough)
            children = (centres[still][:, None] + 0.5 * half * _CORNERS).reshape(-1, 3)
            nearest = np.linalg.norm(np.clip(np.abs(children) - 0.5 * half, 0.0, None), axis=-1)
            children = children[nearest <= radius * (1.0 + 1e-12)]
            if len(children) == 0 or len(children) > _MOST_CELLS or half < _FINEST * radius:
                return max(enough, float(uppers[still].max(initial=0.0))), best, place
            centres, half = children, 0.5 * half

    def above(
        self, mass: float, radius: float, corners: Float[np.ndarray, "cells 8 3"], half: float, bend: float
    ) -> Float[np.ndarray, " cells"]:
        """A bound of d over each cell with these corners, as far as it is within the ball (`_searched`)."""
        slope, columns = math.log1p(-bend) - math.log(bend), self.carrier[:, :3]
        linear = slope * (columns**2).sum(axis=0) + (columns * (self.dual @ columns)).sum(axis=0)
        bulge = mass * float(np.clip(linear, 0.0, None).sum())
        prices = np.append(0.0, slope * mass * (columns**2).sum() * 0.5 ** np.arange(_PRICES))
        values = self.value(self.loaded(mass, corners), bend)
        beyond = (corners**2).sum(axis=-1) - radius**2 - 3.0 * half**2
        means = (values[..., None] - prices * beyond[..., None]).max(axis=1).min(axis=-1)
        return np.asarray(means + bulge * half**2 + self.margin(bend))

    def _found(self, mass: float, at: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, " k"]:
        return np.asarray(self.value(self.loaded(mass, at)))

    @staticmethod
    def _symmetric(x: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        return np.asarray(0.5 * (x + x.T))

    @staticmethod
    def _dual_of(x: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """log X(1 − X)⁻¹, with eigenvalues cut to ±`FARTHEST`."""
        values, own = np.linalg.eigh(x)
        inside = np.clip(values, 1e-300, 1.0 - 1e-16)
        return (own * np.clip(np.log(inside) - np.log1p(-inside), -FARTHEST, FARTHEST)) @ own.T


def of_number(number: UnknownNumber) -> float:
    """d(x‖x₀) of a number that is as the model has it; 0 unless its first estimate was cut.

    Raises CertificateRefused for one outside its bounds.
    """
    x = (number.known - number.lowest) / number.width
    if not 0.0 <= x <= 1.0:
        refuse(f"the model's number of joint {number.joint + 1} is outside the bounds of the law", "correct the model")
    if 0.0 < x < 1.0 and abs(math.log(x) - math.log1p(-x) - number.start) <= 1e-9:
        return 0.0
    entropy = sum(y * math.log(y) for y in (x, 1.0 - x) if y > 0.0)
    return up(max(entropy + float(np.logaddexp(0.0, number.start)) - number.start * x, 0.0) + _TINY)
