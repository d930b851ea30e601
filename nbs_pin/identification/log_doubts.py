"""Questions that the URDF puts to a log: unit, scale and sign of the torques, swapped columns, zeros, delays.

Each joint's torque is regressed on what the URDF's masses need, on velocity, its sign, acceleration and a constant.
Masses are rarely right to better than a third, so only what they cannot explain is questioned, and only where what is
suspected instead explains the torques well. How late the torques are is where the best rigid bodies of the arm's
geometry leave least.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator
from scipy.optimize import linear_sum_assignment

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.doors import BLANK, option
from nbs_pin.base.units import units
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.identification.datasets import Dataset, trajectory_slices
from nbs_pin.identification.regressor import RobotGeometry
from nbs_pin.robots.robot import Robot

_SOME, _FEW = 600, 60
"""Rows that are looked at, and fewest."""
_TRANSITION = 0.01
"""Speed scale of Coulomb friction [rad/s]."""
_ALIKE = 0.8
"""Correlation with the torque of the URDF's masses from which on a joint's torque is known to come from them."""
_MASSES = 4.0
"""Ratio of torques that wrong masses do not explain."""
_DRIVES = -0.3
"""Share of the torque that acts like friction, below which its sign is doubted."""
_GAIN, _WELL = 3.0, 0.3
"""Fall of the sum of ln(unexplained share) that makes a suspicion; largest share that is then unexplained."""
_CONSTANT, _OF_LARGEST, _CLEAR = 0.12, 0.02, 0.1
"""A constant torque worth a word, in deviations of the joint's torque, and in the largest deviation of all joints; and
the largest share of the joint's torque that is then unexplained."""
_LATEST, _STEP, _LATE = 0.2, 0.004, 0.015
"""Longest delay that is tried, resolution, and shortest delay that is told [s]."""
_INDEPENDENT = 1e-10
"""Share of the largest eigenvalue above which a direction of the bodies' parameters counts."""
_LESS = 0.9
"""Unexplained torque without the delay, as a share, for a delay to be told."""


@dataclass(frozen=True)
class LogDoubts:
    """What the URDF finds in a log, by joint, and the questions that follow."""

    slope: JointArray
    """Torque over that of the URDF's masses, by least squares."""
    alike: JointArray
    """Correlation of the two without friction, rotor inertia and a constant."""
    friction: JointArray
    """Share of the torque that acts like friction; negative if it drives the motion."""
    constant: JointArray
    """Constant torque that is left [N·m]."""
    delay: float
    """How late the torques are [s]; NaN if the log does not tell."""
    doubts: tuple[str, ...]
    """Clauses that say what seems wrong and what to do."""


def log_doubts(data: Dataset, robot: Robot) -> LogDoubts:
    """Question a log of that arm; without doubts if it is too short, or has no torque."""
    some = data.take(np.unique(np.linspace(0, len(data) - 1, _SOME).astype(int)))
    nothing = np.full(data.nv, np.nan)
    if len(data) < _FEW or not (data.tau.std(axis=0) > 0.0).any():
        return LogDoubts(nothing, nothing, nothing, nothing, float("nan"), ())
    arm, asked = PinocchioDynamics(robot), _Asked.of(data)
    stated = _stated(arm, some, some.q)
    if not (stated.std(axis=0) > 0.0).any():
        return LogDoubts(nothing, nothing, nothing, nothing, float("nan"), ())
    found = _explained(some, stated)
    names = robot.joint_names
    doubts, delay = [], float("nan")
    if not found.all_turned:  # by which gravity seems to come from the other side
        doubts = [text for text in (_swapped(found, names), _zero(arm, some, found, names, asked)) if text]
    if not doubts:  # which would make the others meaningless
        signs = list(_signs(found, names, asked))
        doubts, delay = [*_scale(found, names, asked), *signs], float("nan") if signs else _delay(data, some, robot)
        if not abs(delay) >= _LATE:
            doubts += _constants(some, found, names)
        else:
            late = "late" if delay > 0.0 else "early"
            doubts.append(
                f"the torques are about {1e3 * abs(delay):.0f} ms {late} in comparison with the motion; give "
                f"{option('delay', round(delay + asked.delay, 3))}"
            )
    return LogDoubts(found.slope, found.alike, found.friction, found.constant, delay, tuple(doubts))


def torque_ratio(data: Dataset, robot: Robot) -> float:
    """The torques over those that the masses of the URDF need; 1 if masses may be so wrong, or if it is not known."""
    some = data.take(np.unique(np.linspace(0, len(data) - 1, _SOME).astype(int)))
    stated = _stated(PinocchioDynamics(robot), some, some.q)
    if len(data) < _FEW or not ((data.tau.std(axis=0) > 0.0).any() and (stated.std(axis=0) > 0.0).any()):
        return 1.0
    return _ratio(_explained(some, stated))


@dataclass(frozen=True)
class _Asked:
    """What the log was corrected by when it was read, to which a remedy adds."""

    gain: JointArray
    zero: JointArray
    delay: float

    @classmethod
    def of(cls, data: Dataset) -> "_Asked":
        """As the data say; none for data that say nothing."""
        asked = data.about.get("asked") or {}
        gain, zero = (asked.get(name) for name in ("torque_gain", "zero"))
        ones = np.ones(data.nv)
        return cls(
            ones if gain is None else ones * np.asarray(gain, dtype=float),
            0.0 * ones if zero is None else ones * np.asarray(zero, dtype=float),
            float(asked.get("delay") or 0.0),
        )

    def gain_times(self, factor: float | Sequence[float]) -> str:
        """The option with the present gain times a factor, one number where joints have the same."""
        gains = [float(f"{x:.6g}") for x in self.gain * np.asarray(factor, dtype=float)]
        plain = [int(x) if x.is_integer() else x for x in gains]
        return option("torque_gain", plain[0] if len(set(plain)) == 1 else plain)


@dataclass(frozen=True)
class _Explained:
    """How the torques follow from those of the URDF's masses, and from friction, rotors and constants."""

    slope: JointArray
    alike: JointArray
    friction: JointArray
    constant: JointArray
    left: Float[np.ndarray, "n n"]
    """Unexplained share of the torque of joint i if it is explained as that of joint j, with a slope ≥ 0."""

    @property
    def all_turned(self) -> bool:
        """Whether the torques of all joints have the other sign: against the masses, and not against the motion."""
        known = np.abs(self.alike) > _ALIKE
        drags = self.friction[np.abs(self.friction) > _CLEAR]
        enough = known.sum() > 1 or (known.size == 1 and known.any() and drags.size > 0)
        return bool(enough and (self.alike[known] < 0.0).all() and (drags < 0.0).all())

    @property
    def own(self) -> JointArray:
        """Unexplained share of each joint's torque."""
        return np.diag(self.left)


def _stated(arm: PinocchioDynamics, data: Dataset, q: np.ndarray) -> np.ndarray:
    return np.asarray(arm.reference_torque(q, data.v, data.v, data.a))


def _explained(data: Dataset, stated: np.ndarray) -> _Explained:
    tau, n = data.tau, data.nv
    slope, alike, friction, constant, left = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.ones((n, n))
    variance = np.maximum(np.square(tau - tau.mean(axis=0)).sum(axis=0), 1e-300)
    for j in range(n):
        v = data.v[:, j]
        kinds = np.column_stack([v, np.tanh(v / _TRANSITION), data.a[:, j], np.ones(len(v))])
        signals = np.column_stack([tau, stated[:, j]])
        rest = signals - kinds @ np.linalg.lstsq(kinds, signals, rcond=None)[0]
        y, z = rest[:, :n], rest[:, n]
        size = max(float(z @ z), 1e-12 * float(stated[:, j] @ stated[:, j]), 1e-300)
        slope[j], own = z @ y[:, j] / size, max(float(y[:, j] @ y[:, j]), 1e-300)
        alike[j] = z @ y[:, j] / np.sqrt(size * own)
        left[:, j] = np.square(y - np.outer(z, np.maximum(z @ y / size, 0.0))).sum(axis=0) / variance
        parts = np.linalg.lstsq(np.column_stack([kinds, stated[:, j]]), tau[:, j], rcond=None)[0]
        drag = kinds[:, :2] @ parts[:2]
        friction[j] = np.sign(drag @ v) * np.square(drag).sum() / max(np.square(tau[:, j]).sum(), 1e-300)
        constant[j] = parts[3]
    return _Explained(slope, alike, friction, constant, np.maximum(left, 1e-12))


def _swapped(found: _Explained, names: Sequence[str]) -> str:
    """Columns of torque that belong to other joints."""
    costs = np.log(found.left)
    rows, places = linear_sum_assignment(costs)
    gain = np.diag(costs) - costs[rows, places]
    moved = [int(i) for i in np.flatnonzero(places != rows)]
    if not moved or gain.sum() < _GAIN or (found.left[moved, places[moved]] > _WELL).any():
        return ""
    fits = ", ".join(f"what is called tau of {names[i]} fits {names[places[i]]}" for i in moved)
    return f"columns of torque seem swapped: {fits}; correct their order or their names"


def _zero(arm: PinocchioDynamics, data: Dataset, found: _Explained, names: Sequence[str], asked: _Asked) -> str:
    """A joint whose zero is elsewhere, or that counts the other way."""
    before = np.log(found.own).sum()
    trials: list[tuple[float, str]] = []
    for i, name in enumerate(names):
        if data.prismatic[i]:
            continue
        for turn in (90, -90, 180):
            q = data.q.copy()
            q[:, i] += np.radians(turn)
            there = _explained(data, _stated(arm, data, q))
            if np.median(there.own) < _WELL:
                said = (
                    f"the zero of {name} seems to be elsewhere than in the URDF: the torques fit q {turn:+d}°; give "
                    f"{option('zero', _moved_zero(asked.zero, i, turn))}"
                )
                trials.append((float(np.log(there.own).sum()), said))
    best = min(trials, default=(before, ""))
    return best[1] if before - best[0] > _GAIN else ""


def _moved_zero(zero: JointArray, joint: int, turn: float) -> list[float]:
    """The zeros with that of one joint turned further [°]."""
    moved = zero + np.where(np.arange(len(zero)) == joint, math.radians(turn), 0.0)
    return [round(float(x), 6) or 0 for x in moved]


def _ratio(found: _Explained) -> float:
    """The torques over those of the masses, 1 where the masses may be so wrong."""
    known = np.abs(found.alike) > _ALIKE
    ratio = float(np.median(np.abs(found.slope[known]))) if known.any() else 1.0
    return 1.0 if 1.0 / _MASSES < ratio < _MASSES else ratio


def _scale(found: _Explained, names: Sequence[str], asked: _Asked) -> Iterator[str]:
    """Torques in another unit."""
    known = np.abs(found.alike) > _ALIKE
    if not known.any():
        return
    ratio = _ratio(found)
    if ratio != 1.0:
        say = f"the torques are {ratio:.3g} times what the masses of the URDF need in these motions"
        if 300.0 < ratio < 3000.0:
            yield f"{say}: are they in N·mm (mN·m)? give {asked.gain_times(0.001)}"
        elif ratio > 1.0:
            yield f"{say}: are they in N·cm or another unit than N·m? convert them with {option('torque_gain', BLANK)}"
        else:
            yield (
                f"{say}: are they motor currents (A), torques on the motors' side of the gears, or not in N·m? give "
                f"{option('torque_gain', BLANK)} with the gains or gear ratios, about "
                f"{float(f'{float(np.median(asked.gain)) / ratio:.2g}'):g} by the masses"
            )
    for i in map(int, np.flatnonzero(known)):
        own = abs(float(found.slope[i])) / float(np.median(np.abs(found.slope[known])))
        if not 1.0 / _MASSES < own < _MASSES and known.sum() > 2 and abs(found.alike[i]) > 0.95:
            yield (
                f"tau of {names[i]} is {own:.3g} times as large, in comparison with the masses of the URDF, as that of "
                f"other joints: has it another gain? give {option('torque_gain', BLANK)} with one number per joint"
            )


def _signs(found: _Explained, names: Sequence[str], asked: _Asked) -> Iterator[str]:
    """Torques that are turned round: against the masses, or in the direction of friction."""
    turned = ((found.alike < -_ALIKE) & (found.friction < -_DRIVES)) | (
        (found.friction < _DRIVES) & (found.alike < _ALIKE) & (found.own < _CLEAR)
    )
    if found.all_turned:
        yield f"the torques have the other sign than q; give {asked.gain_times(-1.0)}"
    if found.all_turned or not turned.any():
        return
    which = ", ".join(names[i] for i in map(int, np.flatnonzero(turned)))
    yield f"tau of {which} has the other sign than q; give {asked.gain_times(np.where(turned, -1.0, 1.0).tolist())}"


def _constants(data: Dataset, found: _Explained, names: Sequence[str]) -> Iterator[str]:
    """Constant torques."""
    deviation = data.tau.std(axis=0)
    size = np.maximum(_CONSTANT * deviation, _OF_LARGEST * deviation.max())
    large = [int(i) for i in np.flatnonzero((np.abs(found.constant) > size) & (found.own < _CLEAR))]
    if large:
        unit = units("torque", data.prismatic)
        told = ", ".join(f"{found.constant[i]:+.3g} {unit[i]} at {names[i]}" for i in large)
        yield f"the torques have constant parts that no motion explains: {told}; are the sensors' zeros right?"


def _delay(data: Dataset, some: Dataset, robot: Robot) -> float:
    """How late the torques are [s], NaN if no rigid arm of that geometry explains them well."""
    inside, delays = _between(data, some), np.arange(-_LATEST, _LATEST + 0.5 * _STEP, _STEP)
    if inside is None or int(inside.sum()) < _FEW:
        return float("nan")
    rows, n = some.take(inside), data.nv
    own = np.array([rows.v, np.tanh(rows.v / _TRANSITION), rows.a, np.ones_like(rows.v)])
    friction = np.einsum("ksj,ij->sikj", own, np.eye(n)).reshape(len(rows), n, -1)
    design = np.concatenate([RobotGeometry(robot).regressor(rows.q, rows.v, rows.a), friction], axis=-1)
    design /= np.maximum(np.linalg.norm(design, axis=(0, 1)), 1e-12)
    deviation = np.maximum(rows.tau.std(axis=0), 1e-6 * rows.tau.std(axis=0).max())
    weighted = (design / deviation[:, None]).reshape(-1, design.shape[-1])
    size, directions = np.linalg.eigh(weighted.T @ weighted)
    known = size > _INDEPENDENT * size[-1]
    if known.sum() > 0.5 * len(weighted):
        return float("nan")
    basis = weighted @ directions[:, known] / np.sqrt(size[known])
    targets = (_later(data, rows, delays) / deviation).reshape(len(delays), -1)
    rest = targets - (targets @ basis) @ basis.T
    left = np.square(rest).reshape(len(delays), -1, n).mean(axis=1)
    if np.median(left.min(axis=0)) > _WELL:
        return float("nan")
    costs = np.log(np.maximum(left, 1e-10)).mean(axis=1)
    k = int(np.argmin(costs))
    if not 0 < k < len(delays) - 1:
        return float("nan")
    before, at, after = costs[k - 1 : k + 2]
    vertex = float(delays[k] + 0.5 * _STEP * (before - after) / max(before - 2.0 * at + after, 1e-12))
    now = costs[int(np.argmin(np.abs(delays)))]
    return vertex if np.exp(at - now) < _LESS else 0.0


def _between(data: Dataset, some: Dataset) -> np.ndarray | None:
    """The rows from whose instant the torque is known for the longest delay before and after."""
    ends = {
        int(data.trajectory[s.start]): (data.t[s.start], data.t[s.stop - 1]) for s in trajectory_slices(data.trajectory)
    }
    first, last = np.array([ends[int(number)] for number in some.trajectory]).T
    inside = (some.t - _LATEST >= first) & (some.t + _LATEST <= last)
    return inside if inside.any() else None


def _later(data: Dataset, rows: Dataset, delays: np.ndarray) -> np.ndarray:
    """The torques that were written later, by each of the delays."""
    tau = np.empty((len(delays), *rows.tau.shape))
    for s in trajectory_slices(data.trajectory):
        mine = rows.trajectory == data.trajectory[s.start]
        if mine.any():
            tau[:, mine] = PchipInterpolator(data.t[s], data.tau[s])(rows.t[mine] + delays[:, None])
    return tau
