"""Exceptions of nbs_pin: each is an `NbsPinError` and also a subclass of the matching built-in exception.

Every message is one sentence that states what was given, what was expected and what to do.
"""


class NbsPinError(Exception):
    """Base class of the errors that this package raises deliberately."""


class RobotError(NbsPinError, ValueError):
    """A robot description that would give a wrong or undefined model; names file, element, value and remedy."""


class RobotNotFound(RobotError, FileNotFoundError):
    """A robot name or path that does not exist; lists the known names."""


class ArgumentError(NbsPinError, ValueError):
    """An argument that is not finite or has the wrong shape, type or range."""


class TooLarge(ArgumentError, OverflowError):
    """Finite arguments whose result is too large to be a number."""


class NoSuchFile(ArgumentError, FileNotFoundError):
    """The path of a file to read that does not exist."""


class MissingExtra(NbsPinError, ImportError):
    """An optional dependency is not installed; names the extra that installs it."""


class SimulationDiverged(NbsPinError, ArithmeticError):
    """The state became non-finite or the physics engine raised a warning; names the time and the cause."""


class FileFormatError(NbsPinError, ValueError):
    """A data file (run, reference, checkpoint) that is damaged or malformed; names file, row or key, and remedy."""


class CertificateRefused(NbsPinError, ValueError):
    """A controller or model that cannot be certified; names the part, the fault and the remedy."""
