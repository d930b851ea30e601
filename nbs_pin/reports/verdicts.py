"""What the figures of a command amount to, in a sentence or two that need no other page to be understood."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from nbs_pin.base.units import measured, several

GOOD, WARNING, BAD, NOTE = "good", "warning", "bad", "note"
"""How a verdict is coloured: kept, to be looked at, broken, and neither."""


class Verdict(NamedTuple):
    """What the results amount to."""

    level: str
    """`GOOD`, `WARNING`, `BAD` or `NOTE`."""
    text: str


def verdict_of(figures: Mapping[str, Any]) -> Verdict:
    """The verdict on the `figures` of a command, told apart by what they hold."""
    return next((judge(figures) for key, judge in _JUDGES.items() if key in figures), Verdict(NOTE, "Finished."))


def _tracking(figures: Mapping[str, Any]) -> Verdict:
    units = figures["units"]["position"]
    bound = measured(0.1, "rad") if set(units) == {"rad"} else f"0.1 {several(units)}"
    times = figures["convergence_time_s"]
    several_starts = isinstance(times, list)
    reached = [time for time in (times if several_starts else [times]) if time is not None]
    count = len(times) if several_starts else 1
    if len(reached) < count:
        many = f"{count - len(reached)} of {count} starts did not converge" if several_starts else "Not converged"
        said = f"{many}: ‖error‖ did not stay below {bound} by the end at {figures['duration_s']:g} s."
    else:
        said = f"Converged: from {max(reached):.3g} s on, ‖error‖ stays below {bound}."
    if not several_starts:
        late = figures["rms_error_late_rad"]
        worst = max(range(len(late)), key=late.__getitem__)
        rms = f"{measured(late[worst], units[worst])} RMS after {figures['late_after_s']:g} s"
        said += f" The worst joint, {figures['joints'][worst]}, is off by {rms}."
    cut = _mean(figures["saturated_fraction"])
    said += f" Torques were cut at their limits {cut:.2%} of the time." if cut else " No torque was cut at its limit."
    outside = figures.get("outside_position_range_rad", [0.0] * len(units))
    beyond = zip(figures["joints"], outside, units, strict=True)
    left = [f"{name} left its range by {measured(excess, unit)}" for name, excess, unit in beyond if excess > 0.0]
    said += f" {'; '.join(left)}." if left else ""
    if "tool" in figures:
        tool = figures["tool"]
        rms, peak = (measured(tool[f"{kind}_position_error_m"], "m") for kind in ("rms", "peak"))
        said += f" {tool['frame']} was {rms} RMS from its path, at most {peak}."
    late_cut = _mean(figures["saturated_fraction_late"])
    return Verdict(BAD if len(reached) < count else WARNING if left or late_cut else GOOD, said)


def _certificate(figures: Mapping[str, Any]) -> Verdict:
    found, attack, seen = figures["certificate"], figures["attack"], figures["monitor"]
    if found["void"]:
        return Verdict(BAD, f"No promise: the bounds are void, as these conditions fail: {'; '.join(found['void'])}.")
    whole = several(found["units"])
    joints = found["joint_errors_rad"]
    worst = max(range(len(joints)), key=joints.__getitem__)
    said = (
        f"Promised ({found['label']}), in the long run and for every disturbance with {found['disturbance']}: all "
        f"errors together, ‖z1‖, stay below {measured(found['error_rad'], whole)}, and {found['joints'][worst]}, the "
        f"joint with the largest bound, below {measured(joints[worst], found['units'][worst])}."
    )
    if figures.get("tip_error_m") is not None:
        said += f" The tip then stays within {measured(figures['tip_error_m'], 'm')} of its path."
    level = GOOD
    if attack is not None:
        share = attack["error_rad"] / found["error_rad"] if found["error_rad"] else 0.0
        said += f" The worst motion found reaches {measured(attack['error_rad'], whole)}, {share:.0%} of that."
        level = BAD if attack["exceeds"] else level
    if seen is not None:
        said += f" The run that was watched: {seen['verdict']}."
        level = level if seen["is_kept"] else BAD
    return Verdict(level, said)


def _learned(figures: Mapping[str, Any]) -> Verdict:
    held_out = figures["rms_test_torque_error_Nm"]
    errors = figures["rms_torque_error_Nm"] if held_out is None else held_out
    where = "the data it was fitted to" if held_out is None else "motions that it has not seen"
    shares = [e / d if d else 0.0 for e, d in zip(errors, figures["torque_deviation_Nm"], strict=True)]
    worst = max(range(len(shares)), key=shares.__getitem__)
    off = measured(errors[worst], figures["units"]["torque"][worst])
    said = (
        f"On {where}, torques are off by {100.0 * shares[worst]:.2g}% of their standard deviation in the worst joint, "
        f"{figures['joints'][worst]}: {off} RMS."
    )
    noise = (figures.get("details") or {}).get("noise_Nm")
    if noise:
        said += f" The noise in the data is {measured(noise[worst], figures['units']['torque'][worst])} there."
    return Verdict(GOOD if shares[worst] < 1.0 else BAD, said)


def _trained(figures: Mapping[str, Any]) -> Verdict:
    share = figures["held_out_cost_lowered_by"]
    before, after = (figures[when]["convergence_time_median_s"] for when in ("before", "after"))
    said = f"On held-out motions the cost is {abs(share):.1%} {'lower' if share >= 0.0 else 'higher'} than before."
    if before is not None and after is not None:
        said += f" Fresh motions converge after {after:.3g} s in the median; before it was {before:.3g} s."
    return Verdict(GOOD if share > 0.0 else WARNING, said)


def _compared(figures: Mapping[str, Any]) -> Verdict:
    off = figures["relative_error"]
    torque, forward = (
        "not finite" if off[name] is None else f"{100.0 * off[name]:.2g}%" for name in ("inverse", "forward")
    )
    said = f"The model's torques are off by {torque} and its accelerations by {forward} (RMS, relative, over the box)."
    return Verdict(NOTE, said)


def _collected(figures: Mapping[str, Any]) -> Verdict:
    covered = figures["covered_range_fraction"]
    least = min(range(len(covered)), key=covered.__getitem__)
    limit = max(figures["at_torque_limit_fraction"])
    said = (
        f"{figures['samples']} samples; every joint covers at least {covered[least]:.0%} of its range, "
        f"{figures['joints'][least]} least."
    )
    said += f" A torque is at its limit in {limit:.1%} of them." if limit > 0.0 else ""
    return Verdict(GOOD if covered[least] >= 0.5 else WARNING, said)


def _mean(value: Any) -> float:
    values = value if isinstance(value, list) else [value]
    return float(sum(values) / len(values))


_JUDGES: dict[str, Callable[[Mapping[str, Any]], Verdict]] = {
    "rms_error_late_rad": _tracking,
    "certificate": _certificate,
    "relative_error": _compared,
    "rms_test_torque_error_Nm": _learned,
    "held_out_cost_lowered_by": _trained,
    "covered_range_fraction": _collected,
}
"""By a figure that only the results of one command have."""
