"""Which terms the drive of each joint has: a ladder of terms, each kept where it predicts data it was not fitted to.

The samples are split into five parts. For every step of the ladder bodies and numbers are fitted without one part, and
judged by the torque they leave in it. A joint keeps a term that improves this enough and whose number has the right
sign, by a higher bar for terms that are seldom needed. The same is done for the torque that a model leaves.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_factor, cho_solve

from nbs_pin.base.arrays import JointArray
from nbs_pin.dynamics.pseudo_inertia import coordinates
from nbs_pin.identification.datasets import Dataset, trajectory_slices
from nbs_pin.identification.drive_terms import SIGNED, TERMS, DriveTerms
from nbs_pin.identification.regressor import triangle

_LADDER = ("coulomb", "viscous", "offset", "rotor", "stribeck", "asymmetry", "load")
"""The terms in the order in which they are tried."""
_PARTS, _BLOCKS = 5, 15
"""Parts of the samples; blocks of time of which they are made where trajectories are few."""
_USUALLY, _USUAL, _SELDOM = ("coulomb", "viscous", "offset", "rotor"), (0.003, 0.5), (0.02, 2.0)
"""Terms that real drives have; least share of the mean square left that these, and the others, must explain, and least
number of standard errors."""
_FEW = 2
"""Samples of a part per candidate below which nothing can be told."""
_EXACT, _SEEN = 1e-6, 1e-5
"""Shares of the torque: the least noise that is assumed, and the residual below which a term is not looked for."""
_LARGEST_LOAD = 0.5
"""Share of the load beyond which its friction is none of a gear."""
_SPEEDS = (0.02, 0.05, 0.1, 0.2, 0.4)
"""Stribeck speeds that are tried, as shares of the joint's largest speed."""
_PRIOR, _RIDGE = 0.3, 1e-12
"""Measurements that the expected bodies are worth; relative ridge of the normal equations."""


@dataclass(frozen=True)
class Wanted:
    """The terms to fit: True for one that every joint has, False for one that none has, None for what the data show."""

    friction: bool | None = None
    """True is viscous and Coulomb friction; None may add asymmetry, the Stribeck effect and dependence on the load."""
    offset: bool | None = None
    rotor_inertia: bool | None = None
    transition: float = 0.01
    """Speed scale of the Coulomb friction [rad/s]."""

    def terms(self) -> Mapping[str, bool | None]:
        """The same for each of `TERMS`."""
        more = None if self.friction is None else False
        given = dict.fromkeys(("viscous", "coulomb"), self.friction) | dict.fromkeys(
            ("asymmetry", "stribeck", "load"), more
        )
        return given | {"offset": self.offset, "rotor": self.rotor_inertia}

    def first(self, n: int) -> DriveTerms:
        """Those that n joints may have before data are looked at: what drives usually have."""
        names = [name for name in _USUALLY if self.terms()[name] is not False]
        return DriveTerms.of(n, *names, transition=self.transition)

    def of_search(self, n: int) -> DriveTerms:
        """Those of `first` that cannot stand for weight while the geometry is unknown: an offset can."""
        return self.first(n) if self.offset else self.first(n).without("offset")

    def settled(self) -> "Wanted":
        """Without what is left to the data."""
        return Wanted(bool(self.friction), bool(self.offset), bool(self.rotor_inertia), self.transition)

    @property
    def is_settled(self) -> bool:
        """Whether nothing is left to the data."""
        return all(wanted is not None for wanted in self.terms().values())


@dataclass(frozen=True, eq=False)
class Candidates:
    """All terms that may be needed, with their factors."""

    wanted: Wanted
    names: tuple[str, ...]
    """Terms; the Stribeck effect once for each speed."""
    speeds: Float[np.ndarray, "options n"]
    """Stribeck speeds [rad/s]."""
    factors: Float[np.ndarray, "kinds samples n"]

    @classmethod
    def of(cls, wanted: Wanted, data: Dataset, needed: Float[np.ndarray, "samples n"]) -> "Candidates":
        """The terms that may be needed for the data; needed: torque without drives [N·m]."""
        speeds = np.outer(_SPEEDS, np.maximum(np.abs(data.v).max(axis=0), 1e-6))
        terms = DriveTerms.of(data.nv, *TERMS, transition=wanted.transition)
        names: list[str] = []
        factors: list[np.ndarray] = []
        for name in _LADDER:
            if wanted.terms()[name] is False:
                continue
            for own in [replace(terms, stribeck_speed=s) for s in speeds] if name == "stribeck" else [terms]:
                names.append(name)
                factors.append(own.factor(name, data, needed))
        return cls(wanted, tuple(names), speeds, np.array(factors).reshape(-1, *data.v.shape))

    def chosen(self, used: Bool[np.ndarray, "kinds n"]) -> tuple[DriveTerms, Int[np.ndarray, "few n"]]:
        """The terms that are used, and for each of their `kinds` the candidate of every joint."""
        n = used.shape[1]
        named = np.array(
            [[bool((used[:, j] & (np.array(self.names) == name)).any()) for j in range(n)] for name in TERMS]
        )
        which = np.array(
            [self._which(used, name) for name, row in zip(TERMS, named, strict=True) if row.any()], dtype=int
        )
        speed = np.full(n, 0.1)
        if "stribeck" in self.names:
            first = self.names.index("stribeck")
            option = self._which(used, "stribeck") - first
            speed = np.where(named[TERMS.index("stribeck")], self.speeds[option, np.arange(n)], speed)
        return DriveTerms(named, self.wanted.transition, speed), which.reshape(-1, n)

    def _which(self, used: np.ndarray, name: str) -> Int[np.ndarray, " n"]:
        """The candidate of a term that each joint uses, the first one where it uses none."""
        own = np.array([k for k, kind in enumerate(self.names) if kind == name])
        return own[np.argmax(used[own], axis=0)]


def parts_of(data: Dataset) -> Int[np.ndarray, " samples"]:
    """The part of each sample: whole trajectories, or blocks of time where there are fewer than parts."""
    _, number = np.unique(data.trajectory, return_inverse=True)
    if number.max() + 1 >= _PARTS:
        return number % _PARTS
    blocks = [np.arange(s.stop - s.start) * _BLOCKS // (s.stop - s.start) for s in trajectory_slices(data.trajectory)]
    return np.concatenate(blocks) % _PARTS


def climb(
    candidates: Candidates,
    triangles: Float[np.ndarray, "parts n rows columns"],
    samples: Int[np.ndarray, " parts"],
    noise: JointArray,
    bodies: int,
    unit: Float[np.ndarray, "kinds n"],
) -> Bool[np.ndarray, "kinds n"]:
    """Which candidates each joint uses.

    Args:
        candidates: The candidates.
        triangles: R of the equations of each part and joint: bodies in units of their expected coordinates, the
            candidates, the torque.
        samples: Samples of each part.
        noise: Residual by which a joint is weighted [N·m].
        bodies: Columns of bodies.
        unit: Unit of the number of every candidate.
    """
    names, terms = np.array(candidates.names), candidates.wanted.terms()
    size = np.sqrt(np.square(triangles[..., -1]).sum(axis=(0, 2)) / samples.sum())
    used = np.array([[terms[name] is True] * len(size) for name in names], dtype=bool).reshape(-1, len(size))
    if len(samples) < _PARTS or samples.min() < _FEW * len(names):
        return used
    least = _EXACT * np.maximum(size, _EXACT * size.max())
    judge = _Judge(triangles, samples, np.maximum(noise, least), bodies)
    left, _ = judge.left(used)
    for name in _LADDER:
        if terms[name] is not None:
            continue
        options = np.flatnonzero(names == name)
        found, means = [], np.full((len(options), len(size)), np.inf)
        for row, k in enumerate(options):
            more = used.copy()
            more[k] = True
            rest, numbers = judge.left(more)
            found.append(rest)
            mean = numbers[:, k].mean(axis=0) * unit[k]
            right = (mean > 0.0) & (mean < (_LARGEST_LOAD if name == "load" else np.inf)) | (name in SIGNED)
            means[row, right] = rest.mean(axis=0)[right]
        for j, row in enumerate(np.argmin(means, axis=0)):
            before, gain = left[:, j].mean(), left[:, j] - found[row][:, j]
            error = gain.std(ddof=1) / np.sqrt(len(gain))
            worth, sure = _USUAL if name in _USUALLY else _SELDOM
            seen = np.isfinite(means[row, j]) and before > (_SEEN * size[j]) ** 2
            if seen and gain.mean() > max(worth * before, sure * error):
                used[options[row], j] = True
        left, _ = judge.left(used)
    return used


class _Judge:
    """What is left in each part by a fit to the others.

    Fits are solved by their normal equations, which are summed over parts; residuals are taken from the equations.
    """

    def __init__(self, triangles: np.ndarray, samples: np.ndarray, noise: JointArray, bodies: int) -> None:
        self.triangles, self.samples, self.bodies = triangles, samples, bodies
        scaled = triangles / noise[:, None, None]
        self.normal = scaled.swapaxes(-1, -2) @ scaled

    def left(
        self, used: Bool[np.ndarray, "kinds n"]
    ) -> tuple[Float[np.ndarray, "parts n"], Float[np.ndarray, "parts kinds n"]]:
        """Mean square of the residual of each joint [N²·m²], and the numbers of the candidates."""
        split = self.bodies
        left, numbers = np.empty((len(self.triangles), used.shape[1])), np.empty((len(self.triangles), *used.shape))
        for part, own in enumerate(self.triangles):
            x, y = self._solved(np.delete(self.normal, part, axis=0).sum(axis=0), used)
            rest = own[:, :, :split] @ x + np.einsum("nrk,kn->nr", own[:, :, split:-1], y) - own[:, :, -1]
            left[part], numbers[part] = np.square(rest).sum(axis=1) / self.samples[part], y
        return left, numbers

    def _solved(
        self, normal: Float[np.ndarray, "n columns columns"], used: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates of the bodies, and the numbers of all candidates, zero for those not used."""
        split, (kinds, joints) = self.bodies, np.nonzero(used)
        numbers = np.zeros(used.shape)
        size = split + len(kinds)
        if not size:
            return np.zeros(0), numbers
        matrix, target = np.zeros((size, size)), np.zeros(size)
        columns = split + kinds
        matrix[:split, :split] = normal[:, :split, :split].sum(axis=0)
        matrix[:split, split:] = normal[joints, :split, columns].T
        matrix[split:, :split] = matrix[:split, split:].T
        same = joints[:, None] == joints
        matrix[split:, split:] = np.where(same, normal[joints[:, None], columns[:, None], columns], 0.0)
        target[:split], target[split:] = normal[:, :split, -1].sum(axis=0), normal[joints, columns, -1]
        diagonal = matrix.diagonal().copy()
        matrix[np.diag_indices(size)] += _RIDGE * np.maximum(diagonal, 1e-300)
        matrix[np.diag_indices(split)] += _PRIOR
        target[:split] += _PRIOR * np.tile(coordinates(np.eye(4)), split // 10)
        solution = cho_solve(cho_factor(matrix), target)
        numbers[kinds, joints] = solution[split:]
        return solution[:split], numbers


def triangles_of(
    rows: Float[np.ndarray, "n samples columns"], parts: Int[np.ndarray, " samples"]
) -> tuple[Float[np.ndarray, "parts n rows columns"], Int[np.ndarray, " parts"]]:
    """R of the equations of every part, filled up with zeros to equal numbers of rows, and the samples of each."""
    each = [triangle(rows[:, parts == part]) for part in range(parts.max() + 1)]
    whole = max(r.shape[1] for r in each)
    filled = [np.pad(r, ((0, 0), (0, whole - r.shape[1]), (0, 0))) for r in each]
    return np.array(filled), np.bincount(parts)


def terms_of_rest(
    wanted: Wanted, data: Dataset, left: Float[np.ndarray, "samples n"]
) -> tuple[DriveTerms, Float[np.ndarray, "kinds n"]]:
    """The terms of the drives, and their numbers, in the torque `left` [N·m] by a model of the bodies."""
    needed, parts = data.tau - left, parts_of(data)
    candidates = Candidates.of(wanted, data, needed)
    rows = np.concatenate([candidates.factors.transpose(2, 1, 0), left.T[..., None]], axis=-1)
    triangles, samples = triangles_of(rows, parts)
    noise = np.maximum(left.std(axis=0), _EXACT * np.maximum(data.tau.std(axis=0), 1e-300))
    used = climb(candidates, triangles, samples, noise, 0, np.ones((len(candidates.names), data.nv)))
    terms, _ = candidates.chosen(used)
    return terms, terms.solved(terms.factors(data, needed), left)
