"""Errors of nbs_pin: each is an `NbsPinError` and also the built-in kind a caller would expect.

Every message is one sentence that says what was given, what was expected and what to do next.
"""


class NbsPinError(Exception):
    """Base of every error this package raises on purpose."""


class RobotError(NbsPinError, ValueError):
    """A robot description that would give a wrong or undefined model; names file, element, value and remedy."""


class RobotNotFound(RobotError, FileNotFoundError):
    """A robot name or path that leads nowhere; lists the names that exist."""


class ArgumentError(NbsPinError, ValueError):
    """An argument of the wrong shape, kind, range or not finite."""


class MissingExtra(NbsPinError, ImportError):
    """An optional dependency is needed; names the extra that installs it."""


class SimulationDiverged(NbsPinError, ArithmeticError):
    """The plant left the finite numbers or the engine raised a warning; names the time and the cause."""


class FileFormatError(NbsPinError, ValueError):
    """A data file (run, reference, checkpoint) that is not what it should be; names file, row or key, and remedy."""


class CertificateRefused(NbsPinError, ValueError):
    """A controller or model of which nothing can be promised; names the part, what is wrong with it and the remedy."""
