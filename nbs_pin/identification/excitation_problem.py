"""What an exciting motion minimises: its condition number and penalties beyond the limits, with their gradient."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import torch
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.records import Reference
from nbs_pin.identification.excitation_units import Units
from nbs_pin.identification.torch_regressor import Rows, TorchRegressor
from nbs_pin.motions.fourier import Fourier, at_rest, waves
from nbs_pin.robots.collisions import SelfDistances
from nbs_pin.robots.robot import Robot

_FEWEST = 10
"""Harmonics that the instants of a search are enough for, however few there are."""
_FINER = 4
"""How much denser position, velocity and acceleration are bounded, which takes no dynamics."""
_SMOOTH = 0.1
"""Transition of the Coulomb friction in the search, a sign that changes over several of its instants [rad/s]."""
_SCALE, _AHEAD = 0.05, 0.01
"""Distance that counts as much as a limit exceeded by its own size, and what the search keeps beyond the clearance, or
half of what there is at rest [m]."""


@dataclass(frozen=True, eq=False)
class Bounds:
    """What the motion may use of an arm, arrays (n,); inf for no bound."""

    middle: JointArray
    """Of the position range [rad]."""
    half: JointArray
    """Largest |q − middle| [rad]."""
    velocity: JointArray
    """Largest |v| [rad/s]."""
    acceleration: JointArray
    """Largest |v̇| [rad/s²]."""
    torque: JointArray
    """Largest |M v̇ + C v + G| + viscous |v| + Coulomb friction [N·m], which bounds it with friction and without."""


class Weight(NamedTuple):
    """How strictly a stage of the search takes its aims."""

    penalty: float
    """Factor of the squared violations."""
    power: float
    """p of the smooth condition number: (Σ λᵖ)^(1/p) (Σ λ⁻ᵖ)^(1/p) → λ_max / λ_min."""
    per_wave: int
    """Instants per period of the highest harmonic."""


def demand(robot: Robot, motion: Reference) -> Float[np.ndarray, "rows n"]:
    """|M v̇ + C v + G| + viscous |v| + Coulomb friction of states (rows, n) [N·m]."""
    data = robot.model.createData()
    torque = np.array([pin.rnea(robot.model, data, *state) for state in zip(*motion, strict=True)])
    return np.asarray(np.abs(torque) + robot.damping * np.abs(motion.v) + robot.friction)


class Problem:
    """Coefficients x (free, n) of a Fourier series: the first row is the offset, the others span `at_rest`.

    In units of the half ranges. The gradient is taken through the regressor at evenly spaced instants of the period.
    """

    def __init__(
        self, robot: Robot, units: Units, bounds: Bounds, duration: float, harmonics: int, near: SelfDistances | None
    ) -> None:
        self.robot, self.units, self.bounds = robot, units, bounds
        self.duration, self.harmonics, self.near = duration, harmonics, near
        self._regressor, self._columns = TorchRegressor(robot), torch.from_numpy(units.columns)
        self._basis = at_rest(harmonics)
        self._known: dict[int, list[torch.Tensor]] = {}
        self._seen: tuple[np.ndarray, np.ndarray] | None = None
        parameters = [body.toDynamicParameters() for body in list(robot.model.inertias)[1:]]
        self._parameters = torch.from_numpy(np.concatenate(parameters))
        self._limits = {
            name: torch.from_numpy(getattr(bounds, name))
            for name in ("middle", "half", "velocity", "acceleration", "torque")
        }
        drive = {"effort": units.effort, "armature": robot.armature}
        drive |= {"damping": robot.damping, "friction": robot.friction}
        self._drive = {name: torch.from_numpy(x) for name, x in drive.items()}

    @property
    def shape(self) -> tuple[int, int]:
        """That of x."""
        return 1 + self._basis.shape[1], self.robot.nv

    def motion(self, x: Float[np.ndarray, "free n"]) -> Fourier:
        """The motion of the coefficients."""
        waves_of = self.bounds.half * (self._basis @ x[1:])
        offset = self.bounds.middle + self.bounds.half * x[0]
        return Fourier(offset, waves_of[: self.harmonics], waves_of[self.harmonics :], self.duration)

    def value(self, x: Float[np.ndarray, " all"], weight: Weight) -> tuple[float, Float[np.ndarray, " all"]]:
        """log of the smooth condition number plus penalties, and its gradient."""
        free = torch.from_numpy(x.reshape(self.shape)).requires_grad_()
        fine = tuple(wave @ free for wave in self._waves(weight.per_wave))
        half = self._limits["half"]
        q, v, a = (half * wave[::_FINER] for wave in fine)
        q = self._limits["middle"] + q
        regressor = self._regressor(q, v, a)
        values = torch.linalg.eigvalsh(self._gram(regressor, v, a)).clamp_min(1e-300).log()
        p = weight.power
        condition = 0.5 / p * (torch.logsumexp(p * values, 0) + torch.logsumexp(-p * values, 0))
        beyond = self._too_far(fine) + self._too_heavy(v, a, regressor) + self._collisions(q)
        total = condition + weight.penalty * beyond
        (slope,) = torch.autograd.grad(total, free)
        return float(total.detach()), slope.numpy().ravel()

    def _waves(self, per_wave: int) -> list[torch.Tensor]:
        """Positions, velocities and accelerations of the coefficients, at `_FINER` times the instants of a search."""
        if per_wave not in self._known:
            count = _FINER * per_wave * max(_FEWEST, self.harmonics)
            w = 2.0 * np.pi / self.duration * np.arange(1, self.harmonics + 1)
            ones = [np.ones((count, 1)), *2 * [np.zeros((count, 1))]]
            rows = zip(ones, waves(np.arange(count) * self.duration / count, w), strict=True)
            self._known[per_wave] = [torch.from_numpy(np.hstack([one, wave @ self._basis])) for one, wave in rows]
        return self._known[per_wave]

    def _gram(self, regressor: torch.Tensor, v: Rows, a: Rows) -> Float[torch.Tensor, "base base"]:
        terms = self.units.terms
        coulomb = torch.tanh(v / max(terms.transition, _SMOOTH))
        factors = {"viscous": v, "coulomb": coulomb, "offset": torch.ones_like(v), "rotor": a}
        every = torch.cat([regressor, *(torch.diag_embed(factors[kind]) for kind in terms.kinds)], dim=-1)
        design = (every / self._drive["effort"][:, None]).flatten(0, 1) @ self._columns
        return design.T @ design / len(design)

    def _too_far(self, fine: tuple[torch.Tensor, ...]) -> torch.Tensor:
        """Mean squared excess of position, velocity and acceleration over their bounds, summed over the joints.

        `fine` are those of the waves, in units of the half ranges; position is bounded by 1.
        """
        limits = self._limits
        rates = [limits[name] / limits["half"] for name in ("velocity", "acceleration")]
        shares = [wave.abs() / bound for wave, bound in zip(fine, [torch.ones_like(rates[0]), *rates], strict=True)]
        return torch.relu(torch.stack(shares) - 1.0).square().mean(dim=1).sum()

    def _too_heavy(self, v: Rows, a: Rows, regressor: torch.Tensor) -> torch.Tensor:
        """The same of the torque."""
        drive = self._drive
        torque = (regressor @ self._parameters + drive["armature"] * a).abs()
        torque = torque + drive["damping"] * v.abs() + drive["friction"]
        return torch.relu(torque / self._limits["torque"] - 1.0).square().mean(dim=0).sum()

    def _collisions(self, q: Rows) -> torch.Tensor:
        """Mean squared lack of distance in units of `_SCALE`, summed over pairs, and to first order a function of q."""
        if self.near is None or not self.near.pairs:
            return q.new_zeros(())
        here = q.detach().numpy()
        least = self.near.least + np.minimum(_AHEAD, 0.5 * (self.near.at_rest - self.near.least))
        if self._seen is None or len(self._seen[0]) != len(here):
            self._seen = here.copy(), np.full(len(here), -np.inf)
        before, nearest = self._seen
        # Rows at which no body can have come near since they were measured are left out.
        rows = np.flatnonzero(nearest < self.near.reach * np.abs(here - before).sum(axis=1))
        if not len(rows):
            return q.new_zeros(())
        distances, slopes = self.near.below(here[rows], least)
        before[rows], nearest[rows] = here[rows], (distances - least).min(axis=1)
        lack = np.maximum(least - distances, 0.0) / _SCALE
        slope = torch.from_numpy(-2.0 / _SCALE / len(here) * np.einsum("kp,kpj->kj", lack, slopes))
        return float(np.square(lack).sum() / len(here)) + (slope * (q - q.detach())[torch.from_numpy(rows)]).sum()
