"""Effects of a measurement on a motion: encoder quantisation, torque noise, and derivatives of sampled signals."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from nbs_pin.base.arguments import check_fields, number
from nbs_pin.base.exceptions import ArgumentError

CLEAN_WINDOW, QUANTISED_WINDOW = 11, 101
"""Window lengths of a derivative [samples], for exact and for quantised signals."""
ORDER = 5
"""Degree of the polynomial fitted to each window."""


@dataclass(frozen=True)
class Noise:
    """Sensor errors: quantised encoders, and white Gaussian noise of the torque measurement.

    Example:
        >>> import nbs_pin as nbs
        >>> noise = nbs.Noise(encoder=2**-16, torque=0.5)
        >>> nbs.collect(nbs.load_robot("two_link"), samples=50, noise=noise)
        Dataset(50 samples of two_link, 2 trajectories, 2 joints)
    """

    encoder: float = 0.0
    """Encoder step as a share of a turn (of 1 m for a prismatic joint), such as 2**-16; 0 for none."""
    torque: float = 0.0
    """Standard deviation of the torque noise [N·m]."""

    def __post_init__(self) -> None:
        check_fields(self, encoder=number(least=0.0, below=0.5, unit="of a turn"), torque=number(least=0.0, unit="N·m"))


def quantised(
    q: Float[np.ndarray, "samples n"], encoder: float, prismatic: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, "samples n"]:
    """q rounded to whole encoder steps [rad, m]; unchanged if `encoder` is 0."""
    if encoder == 0.0:
        return q
    step = encoder * np.where(prismatic, 1.0, 2.0 * np.pi)
    return step * np.round(q / step)


def derivative(
    x: Float[np.ndarray, "samples n"], step: float, window: int, order: int = 1
) -> Float[np.ndarray, "samples n"]:
    """The first or second derivative of samples `step` [s] apart (Savitzky and Golay 1964).

    A polynomial of degree `ORDER` is fitted to `window` samples (odd) about each, at the ends to the last full window.

    Raises:
        ArgumentError: If there are fewer samples than `window`.
    """
    from scipy.signal import savgol_filter

    if len(x) < window:
        raise ArgumentError(f"{len(x)} samples are too few to differentiate over {window}; record a longer motion.")
    return savgol_filter(x, window, min(ORDER, window - 2), deriv=order, delta=step, axis=0)
