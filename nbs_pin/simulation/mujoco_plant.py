"""MuJoCo as a plant, built from the same URDF bytes as the Pinocchio model; the only module that imports mujoco."""

import logging
import threading
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias

import mujoco
import numpy as np

from nbs_pin.base.arguments import DURATION, checked, choice, either, maybe, writable
from nbs_pin.base.arrays import Matrices, Vectors, as_vectors, finite_result
from nbs_pin.base.checks import all_finite
from nbs_pin.base.doors import in_words
from nbs_pin.base.exceptions import ArgumentError, RobotError, SimulationDiverged
from nbs_pin.base.files import write_whole
from nbs_pin.dynamics.friction import FRICTION, JointFriction, friction_of_size, has_viscous_and_coulomb_only
from nbs_pin.robots.robot import ARM, Robot
from nbs_pin.simulation.massless import gather_joints
from nbs_pin.simulation.plant import Plant

_SCRATCH = ("_lock", "_data", "_qpos", "_qvel", "_torque", "_warnings")
_LOGGER = logging.getLogger("nbs_pin.mujoco")
MujocoIntegrator: TypeAlias = Literal["rk4", "euler", "implicitfast"]
JointFrictionChoice: TypeAlias = Literal["drop", "keep"] | JointFriction

_INTEGRATORS = {
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}
_OFF = mujoco.mjtDisableBit
# Autoreset would silently reset a diverged arm; a warm start would make a step depend on the one before.
_ALWAYS_OFF = _OFF.mjDSBL_AUTORESET | _OFF.mjDSBL_WARMSTART | _OFF.mjDSBL_ACTUATION
_UNWANTED = _OFF.mjDSBL_CONTACT | _OFF.mjDSBL_EQUALITY  # dry friction and stops are constraints
# By default a tenth of the free acceleration passes dry friction, so that a light joint neither sticks nor slides; with
# the hardest setting it is Coulomb friction to 1e-4 of the torque.
_DRY_FRICTION_SOLREF = (0.002, 1.0)
# A stop that yields in 4 ms, the shortest time that MuJoCo keeps at a step of 1 or 2 ms.
_STOP_SOLREF = (0.004, 1.0)
_DRY_FRICTION_SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)


class MujocoPlant(Plant):
    """The arm in MuJoCo, without contacts or effort limits, which `simulate` applies.

    MuJoCo's warnings raise SimulationDiverged; for the whole process they go to the logger "nbs_pin.mujoco" instead of
    a file in the working directory. Each plant owns a scratch `mujoco.MjData`, which one thread uses at a time: several
    threads may share a plant, but with a plant for each they need not wait for each other.

    Args:
        robot: The arm.
        integrator: "rk4", "euler" (semi-implicit) or "implicitfast" (semi-implicit, damping implicit). None takes "rk4"
            without friction, else "implicitfast", since joint damping can be too stiff for explicit steps.
        joint_friction: "drop" omits the damping and dry friction of the URDF, as Pinocchio does; "keep" applies both,
            dry friction as MuJoCo's hardest constraint; a `JointFriction` replaces them (its transition is not used).
        joint_stops: "drop" lets joints leave their position limits; "keep" stops them there, by a constraint.

    Raises:
        ArgumentError: If integrator, joint_friction or joint_stops is unknown.
        RobotError: If MuJoCo cannot build the arm.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.MujocoPlant(nbs.load_robot("panda"), joint_friction="keep")
        MujocoPlant(panda, implicitfast, joint_friction=keep)
    """

    @checked(
        robot=ARM,
        integrator=maybe(choice(*_INTEGRATORS)),
        joint_friction=either(FRICTION, choice("drop", "keep")),
        joint_stops=choice("drop", "keep"),
    )
    def __init__(
        self,
        robot: Robot,
        integrator: MujocoIntegrator | None = None,
        joint_friction: JointFrictionChoice = "drop",
        joint_stops: Literal["drop", "keep"] = "drop",
    ) -> None:
        is_dropped = isinstance(joint_friction, str) and joint_friction == "drop"
        integrator = integrator or ("rk4" if is_dropped else "implicitfast")
        if isinstance(joint_friction, JointFriction):
            friction_of_size(joint_friction, robot.nv)
            if not has_viscous_and_coulomb_only(joint_friction):
                raise ArgumentError(
                    f"joint_friction is a {type(joint_friction).__name__}, and MuJoCo's joints have viscous and "
                    "Coulomb friction only; give a JointFriction of these, or simulate a DynamicsPlant."
                )
        mujoco.set_mju_user_warning(_LOGGER.info)
        self._robot, self._nv = robot, robot.nv
        self.integrator = integrator
        self.joint_friction, self.joint_stops = joint_friction, joint_stops
        _, self.model = build_model(robot, integrator, joint_friction, joint_stops)
        ids = [self.model.joint(name).id for name in robot.joint_names]
        self._at_q = _in_order(self.model.jnt_qposadr[ids])
        self._at_v = _in_order(self.model.jnt_dofadr[ids])
        self._bind()

    def _bind(self) -> None:
        self._data, self._lock = mujoco.MjData(self.model), threading.Lock()
        # Views, fetched once: every access through MjData would create new ones.
        self._qpos, self._qvel, self._torque = self._data.qpos, self._data.qvel, self._data.qfrc_applied
        self._warnings = self._data.warning.number

    def __getstate__(self) -> dict[str, Any]:
        """State for pickle and copy: everything but MuJoCo's scratch data."""
        return {name: value for name, value in self.__dict__.items() if name not in _SCRATCH}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the state, with new scratch data."""
        self.__dict__.update(state)
        mujoco.set_mju_user_warning(_LOGGER.info)
        self._bind()

    def _facts(self) -> Iterable[str]:
        stops = ("joint_stops=keep",) if self.joint_stops == "keep" else ()
        return self._robot.name, self.integrator, f"joint_friction={self.joint_friction}", *stops

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self._robot.nv

    @property
    def robot(self) -> Robot:
        """The arm."""
        return self._robot

    @checked(path=writable)
    def write_mjcf(self, path: str | Path) -> Path:
        """Write the arm as MJCF, with its bodies, rotor inertias and the friction of this plant; returns its path.

        MuJoCo writes six digits, without shapes. A motor of unit gear drives every joint within its effort limit.

        Raises:
            OSError: If it cannot be written.

        Example:
            >>> import tempfile
            >>> import nbs_pin as nbs
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     path = nbs.MujocoPlant(nbs.load_robot("two_link")).write_mjcf(f"{folder}/two_link.xml")
            ...     nbs.load_robot(path)
            Robot('two_link', 2 joints, 2 kg, effort 100 N·m)
        """
        spec, _ = build_model(self._robot, self.integrator, self.joint_friction, self.joint_stops)
        for name, effort in zip(self._robot.joint_names, self._robot.effort_limit.tolist(), strict=True):
            motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            if np.isfinite(effort):
                motor.ctrllimited, motor.ctrlrange = True, np.array([-effort, effort])
        spec.compile()
        return write_whole(path, spec.to_xml().encode())

    def step(self, q: Vectors, v: Vectors, tau: Vectors, duration: float) -> tuple[Vectors, Vectors]:
        """State (q, v) after one MuJoCo step of `duration` [s] with τ [N·m] held.

        Raises:
            SimulationDiverged: If an input or the result is not finite, or MuJoCo issues a warning.
        """
        if not (type(duration) is float and 0.0 < duration <= 1.0):
            duration = _DURATION(duration)
        q, v, tau = self._vectors(q=q, v=v, tau=tau)
        with self._lock:
            self.model.opt.timestep = duration
            if q.ndim == 1:
                return self._step_row(q, v, tau)
            result = _stack(lambda *row: np.array(self._step_row(*row)), q, v, tau)
        return result[..., 0, :], result[..., 1, :]

    def acceleration(self, q: Vectors, v: Vectors, tau: Vectors) -> Vectors:
        """v̇ [rad/s²] for the torque τ [N·m], by MuJoCo's forward dynamics."""
        q, v, tau = self._vectors(q=q, v=v, tau=tau)
        with self._lock:
            a = _stack(lambda *row: self._forward(*row).qacc[self._at_v].copy(), q, v, tau)
        return finite_result("v̇", a, q, v, tau)

    def bias(self, q: Vectors, v: Vectors) -> Vectors:
        """C(q, v) v + G(q) [N·m], without joint friction."""
        q, v = self._vectors(q=q, v=v)
        with self._lock:
            torque = _stack(lambda *row: self._forward(*row).qfrc_bias[self._at_v].copy(), q, v, np.zeros_like(v))
        return finite_result("the bias", torque, q, v)

    def mass_matrix(self, q: Vectors) -> Matrices:
        """M(q) [kg·m²]."""
        (q,) = self._vectors(q=q)
        with self._lock:
            return _stack(self._mass_matrix_row, q, np.zeros_like(q), np.zeros_like(q))

    def _vectors(self, **vectors: Vectors) -> tuple[np.ndarray, ...]:
        """The vectors as float arrays of one shape (..., nv)."""
        arrays = as_vectors(self._nv, **vectors)
        if arrays[0].shape[0] == 0:
            raise ArgumentError(f"{self!r} was given no states, arrays of shape {arrays[0].shape}; give at least one.")
        if type(arrays[0]) is not np.ndarray:
            raise ArgumentError(f"{self!r} was given torch tensors, expected numpy arrays; give x.numpy().")
        return arrays

    def _mass_matrix_row(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
        full = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, self._forward(q, v, tau), full)
        return full[self._at_v][:, self._at_v]

    def _forward(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> mujoco.MjData:
        self._set(q, v, tau)
        mujoco.mj_forward(self.model, self._data)
        self._check_warnings()
        return self._data

    def _step_row(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self._set(q, v, tau)
        mujoco.mj_step(self.model, self._data)
        self._check_warnings()
        row = self._qpos[self._at_q].copy(), self._qvel[self._at_v].copy()
        if not (all_finite(row[0]) and all_finite(row[1])):
            raise SimulationDiverged(
                f"{in_words(self, 'the plant')} diverged to a state that is not finite; "
                "take a shorter plant step, or check the controller."
            )
        return row

    def _set(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> None:
        # MuJoCo silently treats a NaN torque as zero, so it must never receive one.
        if not (all_finite(q) and all_finite(v) and all_finite(tau)):
            raise SimulationDiverged(
                f"{in_words(self, 'the plant')} was given q = {q}, v = {v}, torque = {tau}, expected finite numbers; "
                "find where they arise."
            )
        self._qpos[self._at_q] = q
        self._qvel[self._at_v] = v
        self._torque[self._at_v] = tau

    def _check_warnings(self) -> None:
        if np.count_nonzero(self._warnings):
            kind = int(np.flatnonzero(self._warnings)[0])
            cause = mujoco.mju_warningText(kind, int(self._data.warning.lastinfo[kind]))
            mujoco.mj_resetData(self.model, self._data)
            raise SimulationDiverged(
                f"{in_words(self, 'the plant')}: {cause} Take a shorter plant step, or check the controller."
            )


_DURATION = partial(DURATION, "duration")


def build_model(
    robot: Robot, integrator: MujocoIntegrator, joint_friction: JointFrictionChoice, joint_stops: str = "drop"
) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """MuJoCo's description and model of the arm, from its URDF without shapes; raises RobotError if there is none.

    It is built with `MjSpec`, as MuJoCo's XML writer keeps only six digits.
    """
    other: dict[str, tuple[float, float]] = {}
    if isinstance(joint_friction, JointFriction):
        pairs = zip(joint_friction.viscous.tolist(), joint_friction.coulomb.tolist(), strict=True)
        other = dict(zip(robot.joint_names, pairs, strict=True))
    armature = dict(zip(robot.joint_names, robot.model.armature.tolist(), strict=True))
    try:
        spec = mujoco.MjSpec.from_string(_without_inner_world(robot.urdf.without_geometry()))
        for joint in spec.joints:
            joint.armature = armature[joint.name]
            if joint_friction != "keep":
                viscous, dry = other.get(joint.name, (0.0, 0.0))
                joint.damping, joint.frictionloss = np.array([viscous, 0.0, 0.0]), dry
            joint.solref_friction, joint.solimp_friction = _DRY_FRICTION_SOLREF, _DRY_FRICTION_SOLIMP
            if joint_stops == "keep":
                joint.solref_limit = _STOP_SOLREF
        gather_joints(spec)
        spec.option.gravity = robot.gravity_vector
        spec.option.integrator = _INTEGRATORS[integrator]
        off = _UNWANTED if joint_stops == "keep" else _UNWANTED | _OFF.mjDSBL_LIMIT
        if joint_friction == joint_stops == "drop":
            off = _OFF.mjDSBL_CONSTRAINT
        spec.option.disableflags = _ALWAYS_OFF | off
        return spec, spec.compile()
    except ValueError as error:
        raise RobotError(
            f"{robot.source}: MuJoCo cannot build this arm ({error}); correct that link or joint."
        ) from error


def _without_inner_world(xml: bytes) -> str:
    """The description with another name for a link "world" that has a parent: MuJoCo takes that link for the world."""
    arm = ET.fromstring(xml)
    if any(child.get("link") == "world" for child in arm.iterfind("joint/child")):
        names, name = {link.get("name") for link in arm.iterfind("link")}, "world_link"
        while name in names:
            name += "_"
        for key, path in (("name", "link"), ("link", "joint/parent"), ("link", "joint/child")):
            for element in arm.iterfind(path):
                if element.get(key) == "world":
                    element.set(key, name)
    return ET.tostring(arm, encoding="unicode")


def _in_order(addresses: np.ndarray) -> np.ndarray | slice:
    """The addresses, or slice(None) for 0, 1, 2, …, which avoids fancy indexing."""
    return slice(None) if np.array_equal(addresses, np.arange(addresses.size)) else addresses


def _stack(function: Callable[..., np.ndarray], *arrays: np.ndarray) -> np.ndarray:
    """`function` of each row of arrays with one batch shape, stacked with that shape."""
    first = arrays[0]
    if first.ndim == 1:
        return function(*arrays)
    rows = [function(*row) for row in zip(*(x.reshape(-1, x.shape[-1]) for x in arrays), strict=True)]
    return np.array(rows).reshape(first.shape[:-1] + rows[0].shape)
