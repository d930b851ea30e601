"""`nbs-pin verify`: a certificate file checked again by an independent program."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from nbs_pin.cli.values import Verbose, default


@dataclass(frozen=True)
class Verify:
    """Check a certificate file again, in ball arithmetic and without the code that made it.

    Print the verdict and what keeps it from being given. The exit code is 0 only if the bounds are PROVED and all
    that is PROVED was re-verified, and 3 otherwise. Needs the extra nbs-pin[verify].

    Example: nbs-pin verify out/certify-panda/certificate.json
    """

    certificate: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """A certificate.json of nbs-pin certify --json."""
    urdf: Annotated[Path | None, tyro.conf.arg(metavar="ARM.urdf"), default("the one that the file names")] = None
    """The URDF that the arm of the file must be."""
    robot: Annotated[str | None, tyro.conf.arg(metavar="ARM"), default("any")] = None
    """The arm, by name or path, that the certificate must be of."""
    verbose: Verbose = False
    """Also print every statement of the file with what became of it."""
