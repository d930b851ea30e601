"""What the figures of a command amount to: the one sentence that the shell, the pictures and the pages give."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.base.doors import option
from nbs_pin.base.units import counted, measured, percent, several
from nbs_pin.reports.captions import failing
from nbs_pin.reports.challenge_told import challenge_told
from nbs_pin.reports.loads_told import load_learned, loads_told

GOOD, WARNING, BAD, NOTE = "good", "warning", "bad", "note"
"""How a verdict is coloured: kept, to be looked at, broken, and neither."""
_SEVERITY = (NOTE, GOOD, WARNING, BAD)
_IN_TIME = 0.7
"""Share of the time by which an arm must have converged: one that is near its motion later may only be passing it."""
_USABLE = 0.1
"""Torque error over the standard deviation of the torque below which a learned model is good."""
_CONSTANT = 100.0
"""That ratio above which it says nothing, as the torque hardly varies."""

_ILL = 1e5
"""Condition number of an exciting motion above which sensors would leave some parameters to the prior."""


class Verdict(NamedTuple):
    """What the results amount to."""

    level: str
    """`GOOD`, `WARNING`, `BAD` or `NOTE`."""
    said: str
    """The sentence, without its full stop."""
    more: tuple[str, ...] = ()
    """Sentences that qualify it."""

    @property
    def text(self) -> str:
        """All of it."""
        return " ".join(f"{sentence[0].upper()}{sentence[1:]}." for sentence in (self.said, *self.more))


def verdict_of(figures: Mapping[str, Any], *, interrupted: bool = False) -> Verdict:
    """The verdict on the `figures` of a command, told apart by what they hold.

    interrupted: whether they are of a part of what was asked for.
    """
    judge = next((judge for key, judge in _JUDGES.items() if key in figures), _finished)
    verdict = judge(figures)
    if not interrupted:
        return verdict
    level = BAD if verdict.level == BAD else WARNING
    more = () if judge is _finished else (verdict.said, *verdict.more)
    return Verdict(level, "interrupted before its end", more)


def has_converged(figures: Mapping[str, Any]) -> bool:
    """Whether every start of a run was near its motion from a time on that leaves enough of the run to tell."""
    return bool((_times(figures) <= _IN_TIME * figures["duration_s"]).all())


def monitor_level(*, is_kept: bool, broken: Sequence[Any]) -> str:
    """How the verdict on a monitored run is coloured: bounds that were kept say little where an assumption failed."""
    return BAD if not is_kept else WARNING if broken else GOOD


def largest_late_errors(figures: Mapping[str, Any]) -> list[tuple[float, str, str]]:
    """Over the last 30 % of a run, the largest RMS error of all joints of one unit, that unit, and the joint."""
    errors = np.array(figures["rms_error_last_30_percent_rad"], dtype=float)
    errors = errors.reshape(-1, len(figures["joints"])).max(axis=0)
    return _worst(errors.tolist(), figures["units"]["position"], figures["joints"])


def shares(errors: Sequence[float | None], deviations: Sequence[float | None]) -> list[float]:
    """Each torque error over the standard deviation of that torque.

    A deviation counts as at least 1e-9 of the largest, so that where a torque is constant an error of rounding is none,
    and any other is many times what it should be.
    """
    least = 1e-9 * max(map(_number, deviations), default=0.0)
    pairs = [(_number(e), max(_number(d), least)) for e, d in zip(errors, deviations, strict=True)]
    return [e / d if d > 0.0 else math.inf if e > 0.0 else 0.0 for e, d in pairs]


def _finished(figures: Mapping[str, Any]) -> Verdict:
    return Verdict(NOTE, "finished")


def _tracking(figures: Mapping[str, Any]) -> Verdict:
    stopped = figures.get("stopped")
    loads = (*loads_told(figures), *load_learned(figures))
    if stopped:
        said = f"the guard stopped the arm after {stopped['time_s']:.3g} s: {stopped['why']}".rstrip(".")
        return Verdict(BAD, said, loads)
    if "units" not in figures:
        return Verdict(BAD, "ended after too few periods to be judged")
    units, joints = figures["units"]["position"], figures["joints"]
    level, said = _convergence(figures)
    (error, unit, joint), *others = largest_late_errors(figures)
    said += f"; in the last 30 % {joint}, the worst joint, is off by {measured(error, unit)} RMS"
    said += "".join(f", and {joint} by {measured(error, unit)}" for error, unit, joint in others)
    more = [*loads]
    if "tool" in figures:
        tool = figures["tool"]
        kinds = {"position": "m"} | ({"orientation": "rad"} if tool["orientation"] == "hold" else {})
        errors = [
            f"{kind} {measured(_number(tool[f'rms_{kind}_error_{unit}']), unit)} RMS, at most "
            f"{measured(_number(tool[f'peak_{kind}_error_{unit}']), unit)}"
            for kind, unit in kinds.items()
        ]
        more.append(f"'{tool['frame']}' along the {tool['path']} is off in {'; '.join(errors)}")
    cut, late_cut = (float(np.mean(figures[name])) for name in ("saturated_fraction", "saturated_fraction_late"))
    late = f"{percent(late_cut, 2)} after {figures['late_after_s']:g} s"
    more.append(
        f"some joint was at its effort limit {percent(cut, 2)} of the time, {late}" if cut else "no torque was cut"
    )
    names = ("above_velocity_limit_fraction", "above_velocity_limit_fraction_late")
    fast, late_fast = ([_number(share) for share in figures.get(name, [0.0])] for name in names)
    if any(fast):
        joint = joints[int(np.argmax(fast))]
        late = f"{percent(max(late_fast), 2)} after {figures['late_after_s']:g} s"
        more.append(f"joint {joint} was above its velocity limit {percent(max(fast), 2)} of the time, {late}")
    excesses = map(_number, figures.get("outside_position_range_rad", [0.0] * len(joints)))
    beyond = zip(joints, excesses, units, strict=True)
    left = [
        f"joint {joint} left its range by {measured(excess, unit)}" for joint, excess, unit in beyond if excess > 0.0
    ]
    is_warned = left or late_cut or any(late_fast)
    return Verdict(WARNING if level == GOOD and is_warned else level, said, (*more, *left))


def _convergence(figures: Mapping[str, Any]) -> tuple[str, str]:
    units, duration, times = figures["units"]["position"], figures["duration_s"], _times(figures)
    bound = measured(0.1, "rad") if set(units) == {"rad"} else f"0.1 {several(units)}"
    never, late = np.count_nonzero(np.isinf(times)), times[times > _IN_TIME * duration]
    if never:
        many = f"{never} of {times.size} starts did not converge" if times.size > 1 else "not converged"
        return BAD, f"{many}: ‖error‖ did not stay below {bound} by the end at {duration:g} s"
    if late.size:
        many = (
            f"{late.size} of {times.size} starts {'has' if late.size == 1 else 'have'} not shown"
            if times.size > 1
            else "not shown"
        )
        return WARNING, f"{many} to converge: ‖error‖ is below {bound} only since {late.max():.3g} s of {duration:g} s"
    return GOOD, f"converged: from {times.max():.3g} s on, ‖error‖ stays below {bound}"


def _laws(figures: Mapping[str, Any]) -> Verdict:
    """Which law is off the least in the end, beside the others that follow the motion."""
    found = figures["laws"]
    off = {name: largest_late_errors(of) for name, of in found.items() if has_converged(of)}
    lost = [name for name in found if name not in off]
    loads = loads_told(next(iter(found.values())))
    if not off:
        return Verdict(BAD, f"none of {', '.join(found)} converged in the first {percent(_IN_TIME)} of the time", loads)
    told = {name: " and ".join(measured(error, unit) for error, unit, _ in of) for name, of in off.items()}
    least, *others = sorted(off, key=lambda name: off[name])
    said = f"of the laws, {least} has the smallest error, {told[least]} RMS in the last 30 % at its worst joint"
    more = (f"not converged in the first {percent(_IN_TIME)} of the time: {', '.join(lost)}",) if lost else ()
    said = "; ".join([said, *(f"{name} {told[name]}" for name in others)])
    return Verdict(WARNING if lost else GOOD, said, (*more, *loads))


def _times(figures: Mapping[str, Any]) -> np.ndarray:
    """Times of convergence of all starts [s], inf for never."""
    times = np.array(figures["convergence_time_s"], dtype=float).ravel()
    return np.where(np.isnan(times), np.inf, times)


def _worst(values: Sequence[float | None], units: Sequence[str], names: Sequence[str]) -> list[tuple[float, str, str]]:
    """The largest value of each unit, with the unit and its name; values of different units do not compare."""
    each = [(_number(value), unit, name) for value, unit, name in zip(values, units, names, strict=True)]
    return [max((one for one in each if one[1] == unit), key=lambda one: one[0]) for unit in dict.fromkeys(units)]


def _number(value: float | None) -> float:
    """A figure, inf for one that is not finite and that JSON holds as None."""
    return math.inf if value is None or math.isnan(value) else value


def _certificate(figures: Mapping[str, Any]) -> Verdict:
    """What is promised of every joint, how that is known, and for which clock."""
    found, attack, seen = figures["certificate"], figures["attack"], figures["monitor"]
    moves = found["joint_overshoots_rad"] is not None
    worst = _worst(found["joint_overshoots_rad" if moves else "joint_errors_rad"], found["units"], found["joints"])
    strays = " or ".join(measured(error, unit) for error, unit, _ in worst)
    start = "the start given" if moves else "a start on the motion"
    law = f"{figures['law']}, " if figures.get("law") else ""
    told = (
        f"no joint of {figures['arm'] or 'the arm'} strays more than {strays} from its motion under "
        f"{found['disturbance']} ({law}from {start}, in {found['clock']})"
    )
    more = [found["unproved_hold"]] if found["unproved_hold"] else []
    if found["void"]:
        level, said = BAD, f"NOT PROMISED: that {told}"
    else:
        level = WARNING if found["label"] != "PROVED" or found["unproved_hold"] else GOOD
        said = f"{found['label']}: {told}"
        error = measured(_number(found["error_rad"]), several(found["units"]))
        more.append(f"in the long run ‖q − q_d‖ stays below {error}")
        if figures.get("tip_error_m") is not None:
            more[-1] += f", and the tip within {measured(figures['tip_error_m'], 'm')} of its path"
    if attack is not None:
        more += _attacked(attack, found)
        level = BAD if attack["exceeds"] else level
    if figures.get("attack_diverged"):
        more.append(f"no worst motion to compare with the bounds: {figures['attack_diverged']}")
    if seen is not None:
        more.append(f"the run: {seen['verdict']}")
        more += [seen["external"]] if "external" in seen else []
        level = max(level, monitor_level(is_kept=seen["is_kept"], broken=seen["broken"]), key=_SEVERITY.index)
    useless = figures.get("useless") or []
    more += [f"of no use: {text}" for text in useless]
    failed = failing(found["void"], found.get("conditions", ()))
    known = f": the bounds are void, as these conditions fail: {failed}" if failed else ""
    more.append(f"{found['label']}{known or ', under the listed assumptions'}")
    return Verdict(WARNING if level == GOOD and useless else level, said, tuple(more))


def _transient(figures: Mapping[str, Any]) -> Verdict:
    """What is promised while a law learns its load, and what the same law with a fixed model does."""
    found = figures["transient"]
    units, joints = found["units"], found["joints"]

    def most(errors: Sequence[float | None]) -> str:
        return " or ".join(measured(error, unit) for error, unit, _ in _worst(errors, units, joints))

    within = f" within {measured(found['load_radius_m'], 'm')}" if found["load_radius_m"] else ""
    under = "" if found["disturbance"] == "none" else f" under {found['disturbance']}"
    lasting = "at all times" if found["duration_s"] is None else f"for {found['duration_s']:g} s"
    said = (
        f"{found['label']}: no joint of {figures['arm']} strays more than {most(found['joint_errors_rad'])} from its "
        f"motion{under}, whatever it carries up to {found['load_mass_kg']:.3g} kg{within} at {found['frame']} "
        f"({figures['law']}, from {_started(figures)}, {lasting}, in continuous time)"
    )
    more = ["held torques, noise and torques that are cut off are not in the bound; simulate"]
    if found["duration_s"] is not None:
        always = found["joint_errors_always_rad"]
        more.append("at all times no bound is known" if always is None else f"at all times it is below {most(always)}")
    if found["fixed_joint_errors_rad"] is not None:
        strays = most(found["fixed_joint_errors_rad"])
        more.append(f"with a fixed model the worst of two such loads, undisturbed, brings {strays}")
        bounds = found["fixed_joint_error_bounds_rad"]
        certified = f"it is certified to {most(bounds)}" if bounds else f"no certificate: {found['fixed_refused']}"
        more[-1] += f"; {certified}".rstrip(".")
    attack, seen = figures.get("attack"), figures.get("monitor")
    level = GOOD if found["label"] == "PROVED" else WARNING
    if attack is not None:
        ratio = "" if attack["bound_over_found"] is None else f"; certified ÷ found = {attack['bound_over_found']:.2f}"
        left = f"; {counted(attack['runs_left_out'], 'run')} with a torque cut off left out"
        more.append(f"{attack['verdict']}{ratio}{left if attack['runs_left_out'] else ''}")
        level = BAD if attack["exceeds"] else level
    if seen is not None:
        more.append(f"the run: {seen['verdict']}")
        level = max(level, monitor_level(is_kept=seen["is_kept"], broken=seen["broken"]), key=_SEVERITY.index)
    useless = figures.get("useless") or []
    more += [f"of no use: {text}" for text in useless]
    return Verdict(WARNING if level == GOOD and useless else level, said, tuple(more))


def _started(figures: Mapping[str, Any]) -> str:
    """Where the motions of a bound begin."""
    error = figures.get("start_error_rad")
    return f"a start at rest with {measured(error, 'rad')} off every joint" if error else "a start on the motion"


def _attacked(attack: Mapping[str, Any], found: Mapping[str, Any]) -> list[str]:
    """How near the worst motion that was found came to the bound, and why it is beyond it."""
    worst, bound = attack["error_rad"], found["error_rad"]
    how = f"{attack['found_by']}, {attack['duration_s']:.3g} s at {1e3 * attack['period_s']:g} ms"
    share = f", {percent(worst / bound)} of the bound" if bound else ""
    thorough = "" if attack["thorough"] else f"; waves alone, {option('attack', True)} searches further"
    said = [f"worst found by {how}: {measured(worst, several(found['units']))}{share}{thorough}"]
    exceeded = f"BOUND EXCEEDED; the check of this motion against the certificate: {attack['verdict']}"
    return said + ([exceeded] if attack["exceeds"] else [])


def _learned(figures: Mapping[str, Any]) -> Verdict:
    """The joint with the largest torque error, beside how much its torque varies."""
    held_out, joints, units = figures["rms_test_torque_error_Nm"], figures["joints"], figures["units"]["torque"]
    errors, where = (figures["rms_torque_error_Nm"], "the data") if held_out is None else (held_out, "held-out data")
    of_deviation = shares(errors, figures["torque_deviation_Nm"])
    worst = max(range(len(joints)), key=of_deviation.__getitem__)
    off, deviation, noise = (
        measured(_number(values[worst]), units[worst]) if values else ""
        for values in (errors, figures["torque_deviation_Nm"], (figures.get("details") or {}).get("noise_Nm"))
    )
    share = f", {100.0 * of_deviation[worst]:.2g} % of that" if of_deviation[worst] < _CONSTANT else ""
    said = f"on {where} the torque of {joints[worst]}, the worst joint, is off by {off} RMS"
    share = f", where it varies by {deviation}{share}"
    level = GOOD if of_deviation[worst] < _USABLE else WARNING if of_deviation[worst] < 1.0 else BAD
    return Verdict(level, said + share, (f"the noise in the data is {noise} there",) if noise else ())


def _trained(figures: Mapping[str, Any]) -> Verdict:
    """How far the cost on held-out motions fell, and when fresh motions converge."""
    share = figures["held_out_cost_lowered_by"]
    duration = figures["fresh_duration_s"]
    times = (_number(figures[when]["convergence_time_median_s"]) for when in ("before", "after"))
    before, after = (time if time <= _IN_TIME * duration else None for time in times)
    if share is None:
        cost = "the held-out cost is not finite"
    else:
        cost = f"held-out cost {'lowered' if share >= 0.0 else 'raised'} by {percent(abs(share), 1)}"
    if after is None:
        then = f"half of the fresh starts or more do not converge in the first {percent(_IN_TIME)} of {duration:g} s"
        then += "" if before is None else f", where half had converged after {before:.3f} s before training"
        return Verdict(WARNING if before is None and share is not None and share > 0.0 else BAD, f"{cost}; {then}")
    earlier = "fewer did at all" if before is None else f"{before:.3f} s"
    said = f"{cost}; half of the fresh starts have converged after {after:.3f} s, {earlier} before training"
    return Verdict(BAD if share is None else GOOD if share > 0.0 else WARNING, said)


def _compared(figures: Mapping[str, Any]) -> Verdict:
    off = {name: _percent(share) for name, share in figures["relative_error"].items()}
    parts = f"M {off['mass_matrix']}, C v {off['coriolis']}, G {off['gravity']}"
    accelerations = f"its accelerations by {off['forward']}, RMS over the box"
    return Verdict(NOTE, f"its torques are off by {off['inverse']} of the true ones ({parts}), {accelerations}")


def _collected(figures: Mapping[str, Any]) -> Verdict:
    covered, count = figures["covered_range_fraction"], figures["trajectories"]
    least = min(range(len(covered)), key=covered.__getitem__)
    said = f"{counted(figures['samples'], 'sample')} of {counted(count, 'trajectory', 'trajectories')}"
    said += f"; every joint covers at least {percent(covered[least])} of its range, {figures['joints'][least]} least"
    limited = (
        f"at a torque limit in at most {percent(max(figures['at_torque_limit_fraction']), 1)} of the samples of a joint"
    )
    return Verdict(GOOD if covered[least] >= 0.5 else WARNING, said, (limited,))


def _exciting(figures: Mapping[str, Any]) -> Verdict:
    """How well the parameters are excited, and what that takes of the arm."""
    condition, joints = _number(figures["condition_number"]), figures["joints"]
    said = (
        f"condition number {condition:.3g} of {counted(figures['unknowns'], 'unknown')}, in {figures['duration_s']:g} s"
    )
    peaks = []
    for what in ("velocity", "torque"):
        shares = [_number(share) for share in figures[f"peak_{what}_fraction"]]
        most = max(range(len(joints)), key=shares.__getitem__)
        if shares[most] > 0.0:  # of an arm without limits of that kind nothing is taken
            peaks.append(f"{percent(shares[most])} of the {what} limit of {joints[most]}")
    more = [f"at most it takes {' and '.join(peaks)}"] if peaks else []
    if figures["nearest"]:
        first, second = figures["nearest"]
        more.append(f"links {first} and {second} come nearest to each other, {measured(figures['clearance_m'], 'm')}")
    return Verdict(GOOD if condition < _ILL else WARNING, said, tuple(more))


def _challenged(figures: Mapping[str, Any]) -> Verdict:
    is_kept, said, more = challenge_told(figures["standings"])
    return Verdict(GOOD if is_kept else BAD, said, more)


def _benched(figures: Mapping[str, Any]) -> Verdict:
    told = ", ".join(f"{time:.3g} µs of {what}" for what, time in figures["control_step_p50_us"].items())
    return Verdict(NOTE, f"one control step takes, in the median, {told}" if told else "no control step was timed")


def _percent(share: float | None) -> str:
    return "not finite" if share is None else f"{100.0 * share:.2g} %"


def _campaign(figures: Mapping[str, Any]) -> Verdict:
    """Median and worst error over the trials, and how many failed."""
    count, failed = figures["trials"], figures["failed"]
    lost = f"; {failed} failed" if failed else ""
    if failed == count:
        return Verdict(BAD, f"all of {counted(count, 'trial')} failed")
    unit, worst = figures["unit"], figures["worst"]
    median, most = (measured(_number(figures[f"{key}_rms_error_rad"]), unit) for key in ("median", "worst"))
    said = f"median RMS error {median} over {counted(count - failed, 'trial')}, at most {most}{lost}"
    about = f" ({worst['told']})" if worst["told"] else ""
    more = f"the worst is trial {worst['trial']}{about}, at {worst['joint']}"
    cut = figures["saturated"]
    kept = f"{figures['converged']} converged" + (f", torques were cut off in {cut}" if cut else "")
    return Verdict(WARNING if failed else NOTE, said, (more, kept))


_JUDGES: dict[str, Callable[[Mapping[str, Any]], Verdict]] = {
    "standings": _challenged,
    "laws": _laws,
    "groups": _campaign,
    "rms_error_late_rad": _tracking,
    "certificate": _certificate,
    "transient": _transient,
    "relative_error": _compared,
    "rms_test_torque_error_Nm": _learned,
    "held_out_cost_lowered_by": _trained,
    "covered_range_fraction": _collected,
    "condition_number": _exciting,
    "control_step_p50_us": _benched,
    "stopped": _tracking,
}
"""By a figure that only the results of one command have; the last, of a run too short for others, only comes then."""
