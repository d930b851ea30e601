"""Exceptions of nbs_pin: each is an `NbsPinError` and also a subclass of the matching built-in exception.

Every message is one sentence that states what was given, what was expected and what to do.
"""


class NbsPinError(Exception):
    """Base class of the errors that this package raises deliberately.

    Example:
        >>> import nbs_pin as nbs
        >>> try:
        ...     nbs.load_robot("pnda")
        ... except nbs.NbsPinError as error:
        ...     print("did you mean" in str(error))
        True
    """


class RobotError(NbsPinError, ValueError):
    """A robot description that would give a wrong or undefined model; names file, element, value and remedy.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.load_robot("panda", lock=["panda_joint77"])
        Traceback (most recent call last):
            ...
        nbs_pin.base.exceptions.RobotError: ...
    """


class RobotNotFound(RobotError, FileNotFoundError):
    """A robot name or path that does not exist; lists the known names.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.load_robot("pnda")
        Traceback (most recent call last):
            ...
        nbs_pin.base.exceptions.RobotNotFound: no robot 'pnda'...
    """


class ArgumentError(NbsPinError, ValueError):
    """An argument that is not finite or has the wrong shape, type or range.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.Hold([0.1, float("nan")])
        Traceback (most recent call last):
            ...
        nbs_pin.base.exceptions.ArgumentError: ...
    """


class TooLarge(ArgumentError, OverflowError):
    """Finite arguments whose result is too large to be a number.

    Example:
        >>> import nbs_pin as nbs
        >>> dynamics = nbs.PinocchioDynamics(nbs.load_robot("two_link"))
        >>> nbs.bias(dynamics, [0.0, 1.0], [1e200, 1e200])
        Traceback (most recent call last):
            ...
        nbs_pin.base.exceptions.TooLarge: ...
    """


class NoSuchFile(ArgumentError, FileNotFoundError):
    """The path of a file to read that does not exist.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.load("nowhere.nbs")
        Traceback (most recent call last):
            ...
        nbs_pin.base.exceptions.NoSuchFile: ...
    """


class MissingExtra(NbsPinError, ImportError):
    """An optional dependency is not installed; names the extra that installs it.

    Example:
        >>> import nbs_pin as nbs
        >>> issubclass(nbs.MissingExtra, ImportError)
        True
    """


class SimulationDiverged(NbsPinError, ArithmeticError):
    """The state became non-finite or the physics engine raised a warning; names the time and the cause.

    Example:
        >>> import nbs_pin as nbs
        >>> law, plant = nbs.PD.for_robot(nbs.load_robot("two_link")), nbs.DynamicsPlant(nbs.AnalyticDynamics())
        >>> nbs.simulate(plant, law, nbs.Hold([0.0, 0.0]), 1.0, 0.25, effort_limit=float("inf"), q0=[1.0, 1.0])
        Traceback (most recent call last):
            ...
        nbs_pin.base.exceptions.SimulationDiverged: ...
    """


class FileFormatError(NbsPinError, ValueError):
    """A data file (run, reference, checkpoint) that is damaged or malformed; names file, row or key, and remedy.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     np.savetxt(f"{folder}/log.csv", np.zeros((9, 2)), delimiter=",", header="t,q1", comments="")
        ...     nbs.load_log(f"{folder}/log.csv")
        Traceback (most recent call last):
            ...
        nbs_pin.base.exceptions.FileFormatError: ...
    """


class CertificateRefused(NbsPinError, ValueError):
    """A controller or model that cannot be certified; names the part, the fault and the remedy.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.certify(nbs.PD.for_robot(nbs.load_robot("two_link")), [5.0, 5.0])
        Traceback (most recent call last):
            ...
        nbs_pin.base.exceptions.CertificateRefused: ...
    """
