"""What an MJCF description adds to the dynamics of a tree of rigid bodies: couplings that lock joints, and refusals.

Springs, tendons, fluids and closed loops are no part of an arm here; each is refused by name unless the joints that it
acts on are locked. Contacts, sites, cameras, sensors and keyframes change nothing.
"""

import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from nbs_pin.base.exceptions import RobotError
from nbs_pin.robots.mjcf_joints import actuators_of, is_off
from nbs_pin.robots.urdf_checks import lock_too
from nbs_pin.robots.urdf_options import UrdfOptions

Follows = tuple[str, float, float]
_EQ, _WRAP = mujoco.mjtEq, mujoco.mjtWrap
_OF_JOINTS, _OF_TENDONS = int(_EQ.mjEQ_JOINT), int(_EQ.mjEQ_TENDON)
_OF_BODIES = (int(_EQ.mjEQ_CONNECT), int(_EQ.mjEQ_WELD))
_AT_SITES = int(mujoco.mjtObj.mjOBJ_SITE)
_OVER_JOINT, _OVER_SITE = int(_WRAP.mjWRAP_JOINT), int(_WRAP.mjWRAP_SITE)
_OVER_GEOMS = (int(_WRAP.mjWRAP_SPHERE), int(_WRAP.mjWRAP_CYLINDER))


@dataclass(frozen=True)
class Described:
    """A compiled description, the names of its joints, and how it is to be read."""

    model: Any
    source: str
    """What messages call it."""
    joints: list[str]
    locked: set[str]
    options: UrdfOptions

    def refuse(self, problem: str, joints: Iterable[int], remedy: str) -> RobotError:
        """A RobotError whose remedy may also be to lock joints."""
        free = [self.joints[k] for k in joints if self.joints[k] not in self.locked]
        lock = f", or lock what moves with it ({lock_too(self.options, free)})" if free else ""
        return RobotError(f"{self.source}: {problem}; {remedy}{lock}.")

    def free(self, joints: Iterable[int], followers: Iterable[int] = ()) -> list[int]:
        """Those of the joints that are neither locked nor follow another."""
        return [k for k in joints if self.joints[k] not in self.locked and k not in set(followers)]

    def named(self, kind: str, k: int) -> str:
        """An element of the description as messages call it."""
        name = mujoco.mj_id2name(self.model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), k)
        return f"{kind} '{name}'" if name else f"{kind} {k + 1}"


def couplings(it: Described) -> dict[int, Follows]:
    """The joints that an equality makes follow another, q = multiplier · q_source + offset.

    Raises:
        RobotError: For a coupling that is no straight line, or that holds a joint where it is, unless this is locked.
    """
    model, found = it.model, dict[int, Follows]()
    for k in _active(model):
        if int(model.eq_type[k]) != _OF_JOINTS:
            continue
        joint, source = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        if it.joints[joint] in it.options.lock:
            continue
        start = float(model.qpos0[model.jnt_qposadr[joint]])
        bent = model.eq_data[k, 2:5].any()
        if source < 0 or bent or joint in found or source == joint:
            if it.joints[joint] in it.locked:
                continue
            text = "keeps" if source < 0 else "couples"
            at = f" at {start + model.eq_data[k, 0]:g}" if source < 0 else ""
            how = " by more than a straight line" if bent and source >= 0 else ""
            problem = f"{it.named('equality', k)} {text} joint '{it.joints[joint]}'{at}{how}"
            raise it.refuse(problem, [joint], "remove it")
        offset, slope = model.eq_data[k, :2].tolist()
        at_source = float(model.qpos0[model.jnt_qposadr[source]])
        found[joint] = (it.joints[source], slope, start + offset - slope * at_source)
    return found


def check_dynamics(it: Described, followers: Iterable[int]) -> None:
    """Raise RobotError for what changes the dynamics of joints that are not locked and is not modelled here.

    It names the first such part, and every joint that must be locked to be rid of all of them.
    """
    followers = set(followers)
    checks = (_springs, _damping, _fluid, _equalities, _tendons, _actuators, _plugins)
    found = [(problem, it.free(joints, followers), remedy) for check in checks for problem, joints, remedy in check(it)]
    found = [one for one in found if one[1]]
    if found:
        problem, _, remedy = found[0]
        more = f" (and {len(found) - 1} more such parts)" if len(found) > 1 else ""
        concerned = sorted({k for _, joints, _ in found for k in joints})
        all_of_them = len(concerned) == len(it.free(range(it.model.njnt), followers))
        raise it.refuse(problem + more, [] if all_of_them else concerned, remedy)
    _warn_of_idle(it, followers)


def gravity_of(it: Described, followers: Iterable[int]) -> tuple[float, float, float]:
    """The acceleration that acts on the bodies that move [m/s²]: what gravcomp leaves of gravity.

    Raises:
        RobotError: If gravcomp takes another share of the weight off each.
    """
    model = it.model
    gravity = np.zeros(3) if is_off(model, "GRAVITY") else model.opt.gravity
    moving = [b for b in range(1, model.nbody) if model.body_mass[b] > 0.0 and it.free(_above(model, b), followers)]
    shares = {float(model.body_gravcomp[b]) for b in moving}
    if len(shares) > 1 and gravity.any():
        body = max(moving, key=lambda b: float(model.body_gravcomp[b]))
        problem = f"{it.named('body', body)} has gravcomp {model.body_gravcomp[body]:g}, and others another"
        raise RobotError(f"{it.source}: {problem}; give all bodies that move the same gravcomp, such as none.")
    left = 1.0 - max(shares, default=0.0) if gravity.any() else 1.0
    if left != 1.0:
        text = f"{it.source}: gravcomp leaves {left:g} of the weight of its bodies, which is taken as its gravity"
        warnings.warn(f"{text}; give the gravity that acts if it is another.", stacklevel=2)
    x, y, z = (left * gravity).tolist()
    return x, y, z


Found = Iterator[tuple[str, list[int], str]]


def _active(model: Any) -> list[int]:
    off = is_off(model, "EQUALITY", "CONSTRAINT")
    return [] if off else [k for k in range(model.neq) if model.eq_active0[k]]


def _springs(it: Described) -> Found:
    model = it.model
    if is_off(model, "SPRING"):
        return
    for k in range(model.njnt):
        if model.jnt_stiffness[k] != 0.0 or model.jnt_stiffnesspoly[k].any():
            text = f"joint '{it.joints[k]}' has a spring of stiffness {model.jnt_stiffness[k]:g}"
            yield text, [k], "remove its stiffness"


def _damping(it: Described) -> Found:
    model = it.model
    if is_off(model, "DAMPER"):
        return
    for k in range(model.njnt):
        acting = actuators_of(model, k)
        bent = model.dof_dampingpoly[model.jnt_dofadr[k]].any() or model.actuator_dampingpoly[acting].any()
        if bent:
            yield f"joint '{it.joints[k]}' has damping that is not proportional to its speed", [k], "give one number"


def _fluid(it: Described) -> Found:
    model = it.model
    for name in ("density", "viscosity"):
        value = getattr(model.opt, name)
        if value > 0.0:
            yield f"it moves in a fluid of {name} {value:g}", list(range(model.njnt)), f"remove {name}"


def _equalities(it: Described) -> Found:
    model = it.model
    for k in _active(model):
        kind = int(model.eq_type[k])
        if kind == _OF_JOINTS:
            continue
        ends = [int(x) for x in (model.eq_obj1id[k], model.eq_obj2id[k]) if x >= 0]
        if kind in _OF_BODIES:
            bodies = [int(model.site_bodyid[x]) for x in ends] if int(model.eq_objtype[k]) == _AT_SITES else ends
            joints = _between(model, [*bodies, 0][:2])
        elif kind == _OF_TENDONS:
            joints = sorted({joint for tendon in ends for joint in _of_tendon(model, tendon)})
        else:
            joints = list(range(model.njnt))
        does = "closes a loop" if kind in _OF_BODIES else "couples joints in a way that is not modelled"
        yield f"{it.named('equality', k)} {does}", joints, "remove it"


def _tendons(it: Described) -> Found:
    model = it.model
    springs, dampers = not is_off(model, "SPRING"), not is_off(model, "DAMPER")
    rubs = not is_off(model, "FRICTIONLOSS", "CONSTRAINT")
    for k in range(model.ntendon):
        terms = {
            "stiffness": springs and (model.tendon_stiffness[k] or model.tendon_stiffnesspoly[k].any()),
            "damping": dampers and (model.tendon_damping[k] or model.tendon_dampingpoly[k].any()),
            "frictionloss": rubs and model.tendon_frictionloss[k],
            "armature": model.tendon_armature[k],
        }
        for term, value in terms.items():
            if value:
                problem = f"{it.named('tendon', k)} has {term}, which couples joints"
                yield problem, _of_tendon(model, k), f"remove its {term}"


def _actuators(it: Described) -> Found:
    model = it.model
    at_joint = {k for joint in range(model.njnt) for k in actuators_of(model, joint)}
    for k in range(model.nactuator):
        damps = not is_off(model, "DAMPER") and (model.actuator_damping[k] or model.actuator_dampingpoly[k].any())
        for term, value in (("armature", model.actuator_armature[k]), ("damping", damps)):
            if value and k not in at_joint:
                problem = f"{it.named('actuator', k)} has {term} but no joint"
                yield problem, list(range(model.njnt)), f"remove its {term}"


def _plugins(it: Described) -> Found:
    model = it.model
    for b in range(model.nbody):
        if model.nplugin and model.body_plugin[b] >= 0:
            yield f"{it.named('body', b)} has a plugin", list(range(model.njnt)), "remove it"


def _warn_of_idle(it: Described, followers: set[int]) -> None:
    """Name the joints that nothing drives in a description that drives others."""
    model = it.model
    driven = {k for k in range(model.njnt) if actuators_of(model, k)}
    by_tendon = model.actuator_trnid[model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON), 0].tolist()
    driven |= {k for tendon in by_tendon for k in _of_tendon(model, tendon)}
    idle = [it.joints[k] for k in it.free(range(model.njnt), followers) if k not in driven]
    if driven and idle:
        text = f"{it.source}: no actuator drives joints {', '.join(map(repr, idle[:5]))}{' …' * (len(idle) > 5)}"
        remedy = f"lock those that nothing moves ({lock_too(it.options, idle)})"
        warnings.warn(f"{text}; they are taken as driven without limit of effort: {remedy}.", stacklevel=2)


def _above(model: Any, body: int) -> list[int]:
    """The joints between a body and the world."""
    found: list[int] = []
    while body:
        first = int(model.body_jntadr[body])
        found += range(first, first + int(model.body_jntnum[body]))
        body = int(model.body_parentid[body])
    return found


def _between(model: Any, bodies: list[int]) -> list[int]:
    """The joints that move bodies against each other."""
    sets = [set(_above(model, body)) for body in bodies]
    return sorted(set[int]().union(*sets) - sets[0].intersection(*sets)) if sets else []


def _of_tendon(model: Any, tendon: int) -> list[int]:
    """The joints that change the length of a tendon."""
    first, bodies, joints = int(model.tendon_adr[tendon]), list[int](), set[int]()
    for k in range(first, first + int(model.tendon_num[tendon])):
        kind, there = int(model.wrap_type[k]), int(model.wrap_objid[k])
        if kind == _OVER_JOINT:
            joints.add(there)
        elif kind == _OVER_SITE:
            bodies.append(int(model.site_bodyid[there]))
        elif kind in _OVER_GEOMS:
            bodies.append(int(model.geom_bodyid[there]))
    return sorted(joints | set(_between(model, bodies)))
