"""`nbs-pin certify` of a law that adapts: how far the arm strays while it learns a load, beside a fixed law."""

import math
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from nbs_pin.base.doors import option
from nbs_pin.base.plain import plain
from nbs_pin.base.summaries import SUMMARY
from nbs_pin.certificates.adaptive_bound import TransientBound, transient_bound
from nbs_pin.cli.certify import Certify
from nbs_pin.cli.values import SAVED, OptionError, plain_numbers
from nbs_pin.commands.certificate_tables import claims_table
from nbs_pin.commands.inputs import box_or_ball, stated_friction
from nbs_pin.commands.results import Results, drawing, table, tell
from nbs_pin.controllers.adaptive_law import AdaptiveLaw
from nbs_pin.motions.by_name import motion_of
from nbs_pin.reports.captions import chosen
from nbs_pin.reports.certificate_charts import plot_transient
from nbs_pin.reports.verdicts import verdict_of

PICTURE = "certificate.png"
_OF_FIXED_LAWS = (
    *("link", "inertia_within", "gravity_error", "margin", "start_error", "delay", "encoder_bits", "wanted"),
    *("against", "trajectories", "json", "attack", "monitor"),
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
    robot = law.robot
    results = Results.of(options, robot.name, robot)
    results = results.check((PICTURE, SUMMARY), options.force, whose="another certificate")
    with results.made() as folder:
        with notes.status("bounding the law, and simulating the one with a fixed model"):
            bound = _bound(options, law)
        saved = options.controller.endswith(SAVED)
        found = {"law": options.controller.split("/")[-1] if saved else "a law built for it", "arm": robot.name}
        figures: dict[str, Any] = plain(found | {"transient": bound.summary(), "useless": list(bound.useless)})
        verdict = verdict_of(figures)
        with results.replaced((PICTURE,), figures):
            pass
        with drawing(folder / PICTURE) as path:
            law_told = ("controller",) if saved else ("law", "bandwidth")
            settings = chosen(results.facts["settings"], *law_told, "period", "friction", "seed")
            plot_transient(bound, path, settings=settings, verdict=verdict)
    tell(console, verdict.said, verdict.more, _tables(bound), verbose=options.verbose)
    results.show(console, [name for name in (PICTURE, SUMMARY) if (folder / name).exists()])
    return 0


def _bound(options: Certify, law: AdaptiveLaw) -> TransientBound:
    robot, settings = law.robot, {**options.units(), **options.tool.given()}
    period = options.period or 0.001
    motion, duration = motion_of(options.reference, robot, frequency=options.frequency, period=period, **settings)
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
    )


def _tables(bound: TransientBound) -> list[Table]:
    """The bounds of the joints beside the law with a fixed model, and what they rest on."""
    fixed = bound.fixed
    columns = {"bound": bound.joint_errors, "at all\ntimes": bound.joint_errors_always}
    if fixed is not None:
        known, none = fixed.certificate, np.full_like(fixed.joint_errors, np.inf)
        columns["fixed law,\ncertified"] = none if known is None else known.joint_errors
        columns["fixed law,\nsimulated"] = fixed.joint_errors
    shown = table("errors", *columns)
    for name, unit, *row in zip(bound.joint_names, bound.joint_units, *columns.values(), strict=True):
        shown.add_row(name, *(f"{x:.3g} {unit}" if math.isfinite(x) else "none" for x in row))
    return [shown, claims_table("what they rest on", [line.plain() for line in bound.lines])]


def refuse_radius(options: Certify) -> None:
    """Raises OptionError for --payload-radius with a law that does not adapt."""
    if options.payload_radius is not None:
        raise OptionError("--payload-radius is for a law that adapts; omit it, or give --law adaptive.")
