"""`nbs-pin certify` of a law that adapts: how far the arm strays while it learns a load, beside a fixed law."""

import math
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from nbs_pin.base.doors import option
from nbs_pin.base.plain import plain
from nbs_pin.base.records import Run
from nbs_pin.base.summaries import SUMMARY
from nbs_pin.certificates.adaptive_bound import TransientBound, transient_bound
from nbs_pin.certificates.ensemble import motions_of
from nbs_pin.certificates.transient_attack import TransientAttack, transient_attack
from nbs_pin.certificates.transient_check import TransientCheck
from nbs_pin.cli.certify import Certify
from nbs_pin.cli.values import SAVED, OptionError, plain_numbers
from nbs_pin.commands.certificate_tables import claims_table
from nbs_pin.commands.inputs import box_or_ball, stated_friction
from nbs_pin.commands.results import Results, drawing, table, tell
from nbs_pin.controllers.adaptive_law import AdaptiveLaw
from nbs_pin.motions.by_name import motion_of
from nbs_pin.motions.references import DesiredMotion
from nbs_pin.reports.captions import chosen
from nbs_pin.reports.certificate_charts import plot_transient, plot_transient_check
from nbs_pin.reports.verdicts import Verdict, verdict_of

PICTURE, WORST, MONITOR, WATCHED = "certificate.png", "run.npz", "monitor.png", "monitor.csv"
FILES = (PICTURE, WORST, MONITOR, WATCHED, SUMMARY)
_OF_FIXED_LAWS = (
    *("inertia_within", "gravity_error", "margin", "delay", "encoder_bits", "wanted"),
    *("against", "trajectories", "json"),
)
"""Options that say nothing of a law that adapts."""


def certify_adaptive(options: Certify, law: AdaptiveLaw, console: Console, notes: Console) -> int:
    """Bound, write and print, and return the exit code; raises NbsPinError or OSError."""
    fields = Certify.__dataclass_fields__
    given = [name for name in _OF_FIXED_LAWS if getattr(options, name) != fields[name].default]
    if given:
        raise OptionError(
            f"{option(given[0], getattr(options, given[0]))} is for a law with a fixed model, and {options.controller}"
            " has one that adapts; omit it."
        )
    if options.norm and options.disturbance is None:
        raise OptionError("--norm needs --disturbance; give both.")
    law = _carrying(options, law)
    robot = law.robot
    results = Results.of(options, robot.name, robot)
    results = results.check(FILES, options.force, whole={"interrupted": False}, whose="another certificate")
    with results.made() as folder:
        watched = None if options.monitor is None else Run.load(options.monitor)
        with notes.status("bounding the law, and simulating the one with a fixed model"):
            motion, duration = _motion(options, law)
            bound = _bound(options, law, motion, duration)
        seen = None if watched is None else bound.check(watched)
        found, interrupted = None, False
        if options.attack:
            motions = [motion, *motions_of(law.law.dynamics, None, options.seed)[1:]]
            found, interrupted = _attacked(bound, motions, options)
        figures = _figures(options, bound, found, seen)
        verdict = verdict_of(figures, interrupted=interrupted)
        with results.replaced((PICTURE, WORST, MONITOR, WATCHED), figures, interrupted=interrupted) as draft:
            if found is not None:
                found.run.save(draft / WORST)
            if seen is not None:
                seen.save(draft / WATCHED)
        _draw(options, results, (bound, found, seen), verdict)
    tell(console, verdict.said, verdict.more, _tables(bound, found), verbose=options.verbose)
    results.show(console, [name for name in FILES if (folder / name).exists()])
    if interrupted:
        raise KeyboardInterrupt
    return 0


def _carrying(options: Certify, law: AdaptiveLaw) -> AdaptiveLaw:
    """The law, with its load at the link that was asked for; raises OptionError where that is not its own."""
    if options.link is None or options.link == law.frame:
        return law
    if options.controller.endswith(SAVED):
        raise OptionError(f"--link is for a law built here, and '{options.controller}' holds one; omit it.")
    return AdaptiveLaw(law.law, law.adapts, frame=options.link, period=law.period)


def _figures(
    options: Certify, bound: TransientBound, found: TransientAttack | None, seen: TransientCheck | None
) -> dict[str, Any]:
    saved = options.controller.endswith(SAVED)
    figures: dict[str, Any] = {
        "law": options.controller.split("/")[-1] if saved else "a law built for it",
        "arm": bound.law.robot.name,
        "transient": bound.summary(),
        "useless": list(bound.useless),
        "start_error_rad": options.start_error,
        "attack": found and found.summary(),
        "monitor": seen and {"verdict": seen.verdict, "is_kept": seen.is_kept, "broken": list(seen.failures)},
    }
    plained: dict[str, Any] = plain(figures)
    return plained


def _draw(
    options: Certify,
    results: Results,
    found: tuple[TransientBound, TransientAttack | None, TransientCheck | None],
    verdict: Verdict,
) -> None:
    """The pictures."""
    bound, attack, seen = found
    law_told = ("controller",) if options.controller.endswith(SAVED) else ("law", "bandwidth")
    settings = chosen(results.facts["settings"], *law_told, "period", "friction", "seed")
    with drawing(results.folder / PICTURE) as path:
        plot_transient(bound, path, attack=attack, settings=settings, verdict=verdict)
    if seen is not None:
        with drawing(results.folder / MONITOR) as path:
            title = f"{bound.law.robot.name}: a run against the bound of the law that adapts"
            plot_transient_check(seen, path, title=title, settings=settings)


def _motion(options: Certify, law: AdaptiveLaw) -> tuple[DesiredMotion, float]:
    settings, period = {**options.units(), **options.tool.given()}, options.period or 0.001
    return motion_of(options.reference, law.robot, frequency=options.frequency, period=period, **settings)


def _attacked(
    bound: TransientBound, motions: list[DesiredMotion], options: Certify
) -> tuple[TransientAttack | None, bool]:
    """What the search found, and whether Ctrl-C ended it; the bound needs no search."""
    try:
        found = transient_attack(bound, reference=motions, period=options.period, seed=options.seed, progress=True)
    except KeyboardInterrupt:
        return None, True
    return found, found.interrupted


def _bound(options: Certify, law: AdaptiveLaw, motion: DesiredMotion, duration: float) -> TransientBound:
    robot, start = law.robot, None
    if options.start_error:
        start = motion(np.zeros(1)).q[0] + options.start_error * (-1.0) ** np.arange(robot.nv)
    numbers = None if options.disturbance is None else plain_numbers(options.disturbance) or []
    within = min(law.load_radius or 0.0, law.load_across or 0.0)
    return transient_bound(  # which refuses a law that adapts no load
        law,
        law.load_mass or 1.0 if options.unknown_payload is None else options.unknown_payload,
        within if options.payload_radius is None else options.payload_radius,
        disturbance=0.0 if numbers is None else box_or_ball(numbers, robot.nv, norm=options.norm),
        friction=stated_friction(options.friction, robot),
        reference=motion,
        duration=duration,
        q0=start,
    )


def _tables(bound: TransientBound, found: TransientAttack | None) -> list[Table]:
    """The bounds of the joints beside the law with a fixed model, and the worst found; what they rest on."""
    fixed = bound.fixed
    columns = {"bound": bound.joint_errors, "at all\ntimes": bound.joint_errors_always}
    if fixed is not None:
        known, none = fixed.certificate, np.full_like(fixed.joint_errors, np.inf)
        columns["fixed law,\ncertified"] = none if known is None else known.joint_errors
        columns["fixed law,\nsimulated"] = fixed.joint_errors
    shown = table("errors", *columns)
    for name, unit, *row in zip(bound.joint_names, bound.joint_units, *columns.values(), strict=True):
        shown.add_row(name, *(f"{x:.3g} {unit}" if math.isfinite(x) else "none" for x in row))
    searched = () if found is None else (_searched(found),)
    return [shown, *searched, claims_table("what they rest on", [line.plain() for line in bound.lines])]


def _searched(found: TransientAttack) -> Table:
    """The worst found beside the bounds, of the joints and of V."""
    bound, shown = found.bound, table("the worst found", "bound", "worst found", "bound ÷ found")
    limits = [*bound.joint_errors.tolist(), bound.storage_within]
    worst = [*found.joint_errors.tolist(), found.storage]
    for name, unit, most, x in zip((*bound.joint_names, "V"), (*bound.joint_units, "J"), limits, worst, strict=True):
        ratio = Text(f"{most / x:.2f}" if x > 0.0 else "", style="bold red" if x > most else "")
        shown.add_row(name, f"{most:.3g} {unit}", f"{x:.3g} {unit}", ratio)
    return shown


def refuse_radius(options: Certify) -> None:
    """Raises OptionError for --payload-radius with a law that does not adapt."""
    if options.payload_radius is not None:
        raise OptionError("--payload-radius is for a law that adapts; omit it, or give --law adaptive.")
