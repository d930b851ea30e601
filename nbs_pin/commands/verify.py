"""`nbs-pin verify`: a certificate file checked again by an independent program."""

from rich.console import Console
from rich.table import Table
from rich.text import Text

from nbs_pin.base.units import counted
from nbs_pin.cli.exit_codes import NO_PROMISE
from nbs_pin.cli.verify import Verify
from nbs_pin.commands.results import tell, titled
from nbs_pin.robots.robot import load_robot
from nbs_pin.verification.stated import FALSE, OPEN, TAKEN, VERIFIED
from nbs_pin.verification.verify import Verification, verify

_TITLES = {
    FALSE: "not shown true",
    OPEN: "not re-verified",
    VERIFIED: "re-verified",
    TAKEN: "taken as stated: what the rest assumes",
}


def run(options: Verify, console: Console, notes: Console) -> int:
    """Verify, print and return the exit code; raises NbsPinError or OSError."""
    with notes.status(f"checking {options.certificate}"):
        robot = None if options.robot is None else load_robot(options.robot)
        found = verify(options.certificate, urdf=options.urdf, robot=robot)
    shown = _TITLES if options.verbose else (FALSE, OPEN)
    present = [status for status in shown if any(check.status == status for check in found.checks)]
    tell(console, _verdict(found), (), [_table(_TITLES[status], found, status) for status in present], verbose=True)
    return 0 if found.confirmed else NO_PROMISE


def _table(title: str, found: Verification, status: str) -> Table:
    table = titled(title, heads=False)
    table.add_column(overflow="fold")
    table.add_column(overflow="fold")
    style = "bold red" if status in (FALSE, OPEN) else ""
    for check in found.checks:
        if check.status == status:
            table.add_row(Text(check.name, style=style), Text(check.because))
    return table


def _verdict(found: Verification) -> str:
    """One line: what was re-verified, or why the bounds are not confirmed."""
    count = {status: sum(check.status == status for check in found.checks) for status in _TITLES}
    if found.confirmed:
        checks, taken = counted(count[VERIFIED], "check"), counted(count[TAKEN], "statement")
        return f"PROVED, and re-verified in {checks}, given the {taken} taken as stated"
    parts = [] if found.label == "PROVED" else [f"the file says {found.label}"]
    parts += [f"{count[FALSE]} not shown true"] * (count[FALSE] > 0) + [f"{count[OPEN]} not re-verified"] * (
        count[OPEN] > 0
    )
    return f"not confirmed: {', '.join(parts)}"
