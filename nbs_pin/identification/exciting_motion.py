"""An exciting motion for an arm: one whose data determine the arm's parameters well, within the arm's limits."""

import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nbs_pin.base.arguments import PERIOD, SEED, checked, count, flag, joints, maybe, number, writable
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import PerJoint, told, vector_of
from nbs_pin.base.csv_files import write_csv
from nbs_pin.base.doors import option
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.base.shown import Shown, joints_told
from nbs_pin.base.torch_threads import one_thread
from nbs_pin.base.units import percent, units
from nbs_pin.identification.drive_terms import DriveTerms
from nbs_pin.identification.excitation import torque_limits
from nbs_pin.identification.excitation_problem import Bounds, Problem
from nbs_pin.identification.excitation_search import Failure, search
from nbs_pin.identification.excitation_units import Units
from nbs_pin.motions.fourier import Fourier
from nbs_pin.motions.references import resting_posture
from nbs_pin.robots.collisions import SelfDistances
from nbs_pin.robots.robot import ARM, Robot

FEWEST_HARMONICS, MOST_HARMONICS = 2, 50
"""Multiples of 1 / duration in the band."""
_ROWS = 1_000_000
"""Most rows of a file."""
_NEAR, _POSES = 0.05, 400
"""Pairs of bodies that come nearer than this in one of so many random poses are watched in the search [m]."""


@dataclass(frozen=True, eq=False, repr=False)
class ExcitingMotion(Shown):
    """A Fourier series over `duration`, from rest to rest, as `exciting_motion` finds it; held before and after.

    Called with times [s], it gives `Reference(q, v, a)`, as every motion.

    Example:
        >>> import nbs_pin as nbs
        >>> motion = nbs.exciting_motion(nbs.load_robot("two_link"), duration=4.0, starts=1)
        >>> motion(t=[0.0, 4.0]).v.round(9).any(), motion.condition < 100.0
        (np.False_, True)
    """

    joint_names: tuple[str, ...]
    series: Fourier
    """Its coefficients."""
    condition: float
    """Condition number of the regressor, as `exciting_motion` defines it."""
    unknowns: int
    """Number of base parameters, its columns."""
    clearance: float
    """Least distance between bodies of the arm [m]; inf where none were compared."""
    nearest: tuple[str, str] | None
    """The links that come so near to each other."""
    interrupted: bool
    """Whether Ctrl-C ended the search before its end."""

    def _facts(self) -> Iterable[str]:
        return joints_told(len(self.joint_names)), f"{self.duration:g} s", f"condition number {self.condition:.4g}"

    @property
    def duration(self) -> float:
        """Time of its end [s]."""
        return self.series.duration

    @property
    def band(self) -> float:
        """Its highest frequency [Hz]."""
        return len(self.series.sine) / self.duration

    @property
    def largest_jerk(self) -> JointArray:
        """Bound of |ȧ_d| of each joint [rad/s³]."""
        return self.series.largest_jerk

    @property
    def notes(self) -> dict[str, Any]:
        """For `Run.info`."""
        return {"excitation": {"condition": self.condition, "band_hz": self.band, "duration_s": self.duration}}

    def __call__(self, t: Any) -> Reference:
        """Desired motion at t [s]."""
        return self.series(t)

    @checked(path=writable, period=PERIOD)
    def save(self, path: str | Path, *, period: float = 0.001) -> Path:
        """Write a CSV file with a row every `period` [s]: `t`, then `q_JOINT`, `v_JOINT` and `a_JOINT` of every joint.

        `load_reference` reads it, as do the commands with a `--reference`. Returns its path.

        Raises:
            ArgumentError: If that would be more than a million rows, or fewer than four.
        """
        rows = round(self.duration / period) + 1
        if not 4 <= rows <= _ROWS:
            raise ArgumentError(f"period is {told(period)}, for {rows} rows; give one for 4 to {_ROWS} rows.")
        t = np.linspace(0.0, self.duration, rows)
        head = ["t", *(f"{kind}_{name}" for kind in "qva" for name in self.joint_names)]
        return write_csv(Path(path), head, np.column_stack([t, *self(t)]).tolist())


@checked(
    robot=ARM,
    duration=number(above=0.0, most=1000.0, unit="s"),
    band=number(above=0.0, most=100.0, unit="Hz"),
    share=number(above=0.0, most=1.0),
    acceleration=maybe(joints(above=0.0, unit="rad/s²")),
    clearance=maybe(number(least=0.0, most=10.0, unit="m")),
    friction=flag,
    offset=flag,
    rotor_inertia=flag,
    starts=count(1, 10_000, "starts"),
    seed=SEED,
    progress=flag,
)
def exciting_motion(
    robot: Robot,
    *,
    duration: float = 10.0,
    band: float = 1.0,
    share: float = 0.8,
    acceleration: PerJoint | None = None,
    clearance: float | None = 0.01,
    friction: bool = True,
    offset: bool = True,
    rotor_inertia: bool = True,
    starts: int = 24,
    seed: int = 0,
    progress: bool = False,
) -> ExcitingMotion:
    """Find a motion along which the parameters of an arm are identified well: of small condition number, within limits.

    q(t) is a Fourier series with the frequencies 1/duration, 2/duration, … up to `band`, at rest where it begins and
    ends. The condition number is that of the regressor W of the motion,

        W π = τ with rows divided by the effort limits and π in units of the prior of `identify`, on the base parameters

    which is what `identify` reports for data whose torque noise is the same share of every joint's effort limit, for
    unknowns that include friction, offsets and rotor inertia if asked for. The search takes exact gradients
    (docs/theory.md §6). The limits are verified on a grid between whose points none is exceeded, those of the torque
    with the description's joint friction and without. A joint without effort limit gets one as in `collect`.

    Args:
        robot: The arm; its inertias count for the torque alone.
        duration: Length of the motion [s], the period of its lowest frequency.
        band: Highest frequency [Hz]; below the elastic modes of the arm and the bandwidth of its controller.
        share: Largest share of the position ranges, of which the middle is taken (at most one turn), and of the limits
            of velocity, acceleration and torque; the rest is left for errors of model and controller.
        acceleration: Limits of |v̇| [rad/s²], one number or one per joint; None leaves it to torque, velocity and band.
        clearance: Least distance between bodies of the arm that no joint connects [m], or nine tenths of what they have
            in the posture where the arm rests, if that is less; None to leave it out. Bodies are the convex hulls of
            their collision shapes, or of visual ones where there are none. Surroundings are not known.
        friction: Whether viscous and Coulomb friction are to be identified.
        offset: Whether constant torques of the sensors are, which must be told from weight.
        rotor_inertia: Whether rotor inertias are.
        starts: Random starts; more take longer and may find better.
        seed: Seed of the starts; the same seed finds the same motion.
        progress: Show a progress bar at a terminal if the search takes longer than 2 s.

    Returns:
        The motion. Ctrl-C ends the search with the best so far (`ExcitingMotion.interrupted`).

    Raises:
        ArgumentError: If the band does not hold 2 to 50 frequencies, a joint has no room or cannot hold the arm with
            that share of its effort, or no posture keeps the clearance.
        RobotError: If the description is malformed.
        KeyboardInterrupt: If Ctrl-C comes before there is any motion.

    Example:
        >>> import nbs_pin as nbs
        >>> motion = nbs.exciting_motion(nbs.load_robot("two_link"), duration=4.0, starts=1)
        >>> motion.duration, motion.band
        (4.0, 1.0)
    """
    harmonics, effort = _harmonics(duration, band), torque_limits(robot)
    bounds = _bounds(robot, share, acceleration, effort)
    every = None if clearance is None else _distances(robot, clearance)
    near = None if every is None else every.restricted(_random(bounds), _NEAR)
    wanted = {"viscous": friction, "coulomb": friction, "offset": offset, "rotor": rotor_inertia}
    names = [name for name, is_wanted in wanted.items() if is_wanted]
    in_units = _units(robot, DriveTerms.of(robot.nv, *names), bounds, harmonics / duration, effort)
    with one_thread():
        found = search(Problem(robot, in_units, bounds, duration, harmonics, near), every, starts, seed, progress)
    if isinstance(found, Failure):
        raise ArgumentError(_why(found, robot, share, bounds, clearance))
    unknowns, clear, nearest = in_units.base.shape[1], found.clearance, found.nearest
    return ExcitingMotion(robot.joint_names, found.motion, found.condition, unknowns, clear, nearest, found.interrupted)


def _harmonics(duration: float, band: float) -> int:
    """The number of multiples of 1/duration within the band; raises ArgumentError if they are too few or too many."""
    harmonics = int(band * duration + 1e-9)
    if not FEWEST_HARMONICS <= harmonics <= MOST_HARMONICS:
        remedy = "a longer duration or a wider band" if harmonics < FEWEST_HARMONICS else "less of either"
        raise ArgumentError(
            f"{duration:g} s and a band of {band:g} Hz hold {harmonics} multiples of 1/duration, expected "
            f"{FEWEST_HARMONICS} to {MOST_HARMONICS}; give {remedy}."
        )
    return harmonics


def _units(robot: Robot, terms: DriveTerms, bounds: Bounds, band: float, effort: JointArray) -> Units:
    """The units for motions within the bounds, whose highest frequency is `band` [Hz]."""
    speed = np.minimum(bounds.velocity, 2.0 * np.pi * band * bounds.half)
    pull = np.minimum(bounds.acceleration, 2.0 * np.pi * band * speed)
    lowest = Reference(bounds.middle - bounds.half, -speed, -pull)
    highest = Reference(bounds.middle + bounds.half, speed, pull)
    return Units.of(robot, terms, effort, lowest, highest)


def _bounds(robot: Robot, share: float, acceleration: PerJoint | None, effort: JointArray) -> Bounds:
    """What the motion may use; raises ArgumentError for a joint that cannot move."""
    lower, upper = robot.one_turn_range
    middle, half = 0.5 * (lower + upper), 0.5 * share * (upper - lower)
    given = np.inf if acceleration is None else acceleration
    most = np.full(robot.nv, given) if np.size(given) == 1 else vector_of("acceleration", given, robot.nv)
    for i, joint in enumerate(robot.joints):
        turning, moving = (units(quantity, [joint.prismatic])[0] for quantity in ("position", "torque"))
        if not half[i] > 0.0:
            raise ArgumentError(
                f"joint '{joint.name}' has the range [{lower[i]:.6g}, {upper[i]:.6g}] {turning}, which leaves no room "
                f"to move; widen it or fix the joint, {option('lock', [joint.name])}."
            )
        if not joint.friction < share * effort[i]:
            raise ArgumentError(
                f"the Coulomb friction {joint.friction:g} {moving} of joint '{joint.name}' takes all of "
                f"{percent(share)} of its effort limit {effort[i]:.4g} {moving}; correct one, or give a larger share."
            )
    velocity = share * robot.velocity_limit
    return Bounds(middle, half, velocity, share * most, share * effort)


def _distances(robot: Robot, clearance: float) -> SelfDistances:
    """The distances between all bodies; warns of shapes that cannot be read."""
    every = SelfDistances(robot, resting_posture(robot), clearance)
    for link, fault in every.faults.items():
        warnings.warn(f"link '{link}' is not kept clear of the others: {fault}", stacklevel=4)
    return every


def _random(bounds: Bounds) -> np.ndarray:
    """Random configurations within the bounds."""
    return bounds.middle + bounds.half * np.random.default_rng(0).uniform(-1.0, 1.0, (_POSES, len(bounds.middle)))


def _why(failure: Failure, robot: Robot, share: float, bounds: Bounds, clearance: float | None) -> str:
    """Why there is no motion, and what to do."""
    if failure.joint is not None:
        joint = robot.joints[failure.joint]
        (unit,) = units("torque", [joint.prismatic])
        return (
            f"joint '{joint.name}' cannot hold the arm with {percent(share)} of its effort, "
            f"{bounds.torque[failure.joint]:.4g} {unit}, together with the others in any posture that was tried; give "
            "a larger share, or correct effort limits or masses."
        )
    if failure.nearest is None:
        return f"no motion of {robot.name} within its limits was found; give more starts or a larger share."
    first, second = failure.nearest
    return (
        f"no posture was found that keeps {clearance:g} m between all bodies, least often '{first}' and "
        f"'{second}'; give a smaller clearance, or correct their collision shapes."
    )
