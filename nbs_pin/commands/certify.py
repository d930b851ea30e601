"""`nbs-pin certify`: bounds of the tracking error before the arm moves, and the worst motion that a search finds."""

import dataclasses
from pathlib import Path
from typing import Any

from rich.console import Console

from nbs_pin.base.exceptions import CertificateRefused
from nbs_pin.base.plain import plain
from nbs_pin.base.records import Run
from nbs_pin.base.summaries import SUMMARY
from nbs_pin.certificates.assess import TRAJECTORIES, Certified, Task, arm_of, assess, design
from nbs_pin.certificates.certificate_file import is_in_its_file, write_certificate
from nbs_pin.certificates.encoders import Encoders
from nbs_pin.certificates.loads import MARGIN
from nbs_pin.certificates.model_structure import is_exact
from nbs_pin.certificates.tip_bound import tip_bound
from nbs_pin.certificates.uncertainty import Uncertainty
from nbs_pin.cli.certify import Certify
from nbs_pin.cli.exit_codes import NO_PROMISE
from nbs_pin.cli.values import SAVED, OptionError, plain_numbers
from nbs_pin.commands.certificate_tables import print_certificate
from nbs_pin.commands.certify_adaptive import certify_adaptive, refuse_radius
from nbs_pin.commands.inputs import box_or_ball, stated_friction
from nbs_pin.commands.results import Results, drawing
from nbs_pin.controllers.adaptive_law import AdaptiveLaw
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.controllers.registry import build_law
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.motions.by_name import motion_of
from nbs_pin.reports.captions import chosen
from nbs_pin.reports.certificate_charts import plot_certificate, plot_monitor
from nbs_pin.reports.verdicts import verdict_of
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.storage.checkpoints import load, load_with, save

FILES = ("certificate.png", "run.npz", SUMMARY)
"""Files of `write_results`; run.npz only if a worst motion was found."""
MONITOR, WATCHED = "monitor.png", "monitor.csv"
DESIGNED, CERTIFICATE, ARM = "controller.nbs", "certificate.json", "arm.urdf"
"""Further files, for a monitored run, for a design and for `nbs-pin verify`."""


def run(options: Certify, console: Console, notes: Console) -> int:
    """Certify, write and print, and return the exit code.

    Raises NbsPinError, OSError, and KeyboardInterrupt after an early end.
    """
    if options.wanted is not None and options.controller.endswith(SAVED):
        raise OptionError(f"--wanted designs a controller, and '{options.controller}' is one; give an arm.")
    with notes.status(f"loading {options.controller}"):
        truth = None if options.against is None else load_robot(options.against, **options.arm.given())
        controller = _controller(options, truth)
        if isinstance(controller, AdaptiveLaw):
            return certify_adaptive(options, controller, console, notes)
        refuse_radius(options)
        task = _task(options, controller, truth)
        robot = arm_of(controller, task)
        watched = None if options.monitor is None else Run.load(options.monitor)
    results = Results.of(options, robot.name, robot, against=robot.source)
    results = results.check(
        (*FILES, MONITOR, WATCHED, *([] if options.wanted is None else [DESIGNED]), CERTIFICATE, ARM),
        options.force,
        whole={"interrupted": False},
        whose="another certificate",
    )
    with results.made() as folder:
        proposal = None
        if options.wanted is not None:
            wanted = plain_numbers(options.wanted) or []
            proposal = design(robot, task, wanted[0] if len(wanted) == 1 else wanted, period=options.period)
            controller, task = proposal.controller, dataclasses.replace(task, period=proposal.period)
        result = assess(controller, task, thorough=options.attack, run=watched, proposal=proposal, progress=True)
        with notes.status(f"drawing the picture into {folder}"):
            found, written = write_results(result, results, as_file=options.json)
    print_certificate(console, found, verbose=options.verbose)
    if result.interrupted:
        console.print("the search for the worst motion was interrupted; the bound is whole", style="yellow")
    results.show(console, written, *(("verify", folder / CERTIFICATE) if options.json else ()))
    if result.interrupted:
        raise KeyboardInterrupt
    return NO_PROMISE if result.certificate.void else 0


def _controller(options: Certify, truth: Robot | None) -> LyapunovLaw | AdaptiveLaw:
    """The controller in a .nbs file, or the law built for an arm.

    Raises CertificateRefused if it has no Lyapunov function.
    """
    settings = {"bandwidth": options.bandwidth, "period": options.period or 0.001, "seed": options.seed}
    name = options.controller
    if name.endswith(SAVED) and options.feed_friction:
        raise OptionError(f"--feed-friction is for a law built here, and '{name}' holds one; omit it.")
    if name.endswith(SAVED):
        if truth is None:
            options.arm.refuse_without_arm(f"'{name}' names its arm; omit it")
        law: Any = load(name) if truth is None else load_with(name, truth)
    else:
        robot = load_robot(name, **options.arm.given())
        stated = stated_friction(options.friction, robot) or JointFriction.of(robot)
        law = build_law(options.law, robot, friction=stated if options.feed_friction else None, **settings)
    if not isinstance(law, LyapunovLaw | AdaptiveLaw):
        what = (
            f"{name} holds a controller of class {type(law).__name__}"
            if name.endswith(SAVED)
            else f"--law {options.law}"
        )
        raise CertificateRefused(
            f"{what}, of which no Lyapunov function is known; give one that has it, such as nbs or slotine-li."
        )
    return law


def _task(options: Certify, controller: LyapunovLaw, truth: Robot | None) -> Task:
    """The task that the options describe; raises OptionError if they do not fit each other."""
    _check_options(options)
    period = options.period or 0.001
    blank = Task(reference=_no_motion, truth=truth)
    robot = arm_of(controller, blank)
    if options.trajectories is not None and is_exact(controller.dynamics, robot):
        raise OptionError(
            f"--trajectories applies to a model that is not exact, and this one is exact for {robot.name}; "
            "omit it, or give the true arm with --against."
        )
    settings = {**options.units(), **options.tool.given()}
    motion, duration = motion_of(options.reference, robot, frequency=options.frequency, period=period, **settings)
    numbers = None if options.disturbance is None else plain_numbers(options.disturbance) or []
    return dataclasses.replace(
        blank,
        reference=motion,
        duration=duration,
        period=period,
        disturbance=None if numbers is None else box_or_ball(numbers, robot.nv, norm=options.norm),
        payload=options.unknown_payload,
        link=options.link,
        friction=stated_friction(options.friction, robot),
        gravity_error=options.gravity_error,
        margin=MARGIN if options.margin is None else options.margin,
        start_error=options.start_error,
        uncertainty=None if options.inertia_within is None else Uncertainty(inertia=options.inertia_within),
        trajectories=options.trajectories or TRAJECTORIES,
        delay=options.delay,
        encoders=None if options.encoder_bits is None else Encoders.of_bits(options.encoder_bits),
        seed=options.seed,
    )


def _check_options(options: Certify) -> None:
    """Raises OptionError for options that need others which were not given."""
    loads = {"--unknown-payload": options.unknown_payload, "--gravity-error": options.gravity_error}
    if options.inertia_within is not None and (options.wanted is not None or options.against is not None):
        raise OptionError("--inertia-within is for the law's own model; omit --wanted and --against.")
    if (options.delay or options.encoder_bits is not None) and options.wanted is not None:
        raise OptionError("--delay and --encoder-bits are no part of a design; omit --wanted.")
    if options.norm and options.disturbance is None:
        raise OptionError("--norm needs --disturbance; give both.")
    if options.link is not None and options.unknown_payload is None:
        raise OptionError("--link needs --unknown-payload; give both.")
    if options.margin is not None and all(load is None for load in loads.values()):
        raise OptionError(f"--margin needs one of {', '.join(loads)}; give one too.")


def figures(result: Certified) -> dict[str, Any]:
    """All results as JSON can store them, with units in the keys; None for numbers that are not finite."""
    certificate, found, proposal = result.certificate, result.attack, result.proposal
    arm = certificate.robot
    numbers: dict[str, Any] = {
        "arm": None if arm is None else arm.name,
        "tip_error_m": None
        if arm is None or certificate.void
        else tip_bound(arm, certificate.joint_errors, certificate.error),
        "certificate": certificate.summary(),
        "disturbance_label": str(certificate.admissible.label),
        "useless": list(certificate.useless),
        "attack": None,
        "attack_diverged": result.diverged or None,
        "monitor": None,
        "design": None,
    }
    if found is not None:
        numbers["attack"] = {
            "error_rad": found.error,
            "joint_errors_rad": found.joint_errors,
            "certified_over_found": certificate.error / found.error if found.error > 0.0 else None,
            "exceeds": result.exceeding is not None,
            "verdict": None if result.exceeding is None else result.exceeding.verdict,
            "found_by": found.found_by,
            "thorough": result.thorough,
            "duration_s": found.duration,
            "period_s": found.period,
        }
    if result.watched is not None:
        watched = result.watched
        numbers["monitor"] = {
            "verdict": watched.verdict,
            "is_kept": watched.is_kept,
            "is_wrong": watched.is_wrong,
            "broken": watched.broken,
            "largest_share": float((watched.storage / watched.promise).max()) if watched.promise.all() else None,
            "largest_error_rad": float(watched.error.max()),
            "largest_error_bound_rad": float(watched.error_bound.max()),
            "external": str(watched.external),
            "largest_external_Nm": watched.external.largest,
            "declared_Nm": watched.external.declared,
        }
    if proposal is not None:
        numbers["design"] = {
            "bandwidth_rad_per_s": proposal.gains.bandwidth,
            "stiffness_Nm_per_rad": proposal.gains.stiffness,
            "rate_rad_per_s_per_Nm": proposal.gains.rate,
            "damping_Nms_per_rad": proposal.gains.damping,
            "period_s": proposal.period,
            "error_rad": proposal.error,
            "joint_errors_rad": proposal.joint_errors,
            "torque_Nm": proposal.torque,
            "torque_share": proposal.share,
        }
    plained: dict[str, Any] = plain(numbers)
    return plained


def write_results(result: Certified, results: Results, *, as_file: bool = False) -> tuple[dict[str, Any], list[str]]:
    """Write the files, the pictures last; returns the figures and the names of the files.

    as_file: whether to write `CERTIFICATE`, and `ARM` if no URDF file states what was certified; no file of another
    certificate stays in the folder.
    Raises OSError if they cannot be written.
    """
    given, folder = results.facts["settings"], results.folder
    saved = given["controller"].endswith(SAVED)
    found = {"law": Path(given["controller"]).name if saved else "a law built for it"} | figures(result)
    names = (FILES[1], WATCHED, DESIGNED, CERTIFICATE, ARM, FILES[0], MONITOR)
    with results.replaced(names, found, interrupted=result.interrupted) as draft:
        if result.attack is not None:
            result.attack.run.save(draft / FILES[1])
        if result.watched is not None:
            result.watched.save(draft / WATCHED)
        if result.proposal is not None:
            save(result.proposal.controller, draft / DESIGNED)
        if as_file:
            write_certificate(result.certificate, draft / CERTIFICATE)
            robot = result.certificate.robot
            if robot is not None and not is_in_its_file(robot):
                (draft / ARM).write_bytes(robot.urdf.without_geometry())
    law = ("controller",) if saved else ("law", "bandwidth")
    settings = chosen(given, *law, "period", "friction", "unknown_payload", "delay", "encoder_bits", "seed")
    with drawing(folder / FILES[0]) as path:
        plot_certificate(result.certificate, result.attack, path, settings=settings,
                         verdict=verdict_of(found | {"monitor": None}))  # fmt: skip
    if result.watched is not None:
        with drawing(folder / MONITOR) as path:
            title = f"{found['arm'] or 'a run'}: a run against its certificate"
            plot_monitor(result.watched, path, units=result.certificate.joint_units, title=title, settings=settings)
    written = (FILES[0], FILES[1], MONITOR, WATCHED, DESIGNED, CERTIFICATE, ARM, SUMMARY)
    return found, [name for name in written if (folder / name).exists()]


def _no_motion(t: Any) -> Any:
    raise OptionError("no reference was chosen; give --reference.")
