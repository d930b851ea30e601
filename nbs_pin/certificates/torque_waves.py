"""Admissible disturbances as signals in time: the initial ones of `attack`, and random ones."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.certificates.admissible import Admissible

Instants: TypeAlias = Float[np.ndarray, " steps"]
Torques: TypeAlias = Float[np.ndarray, "steps n"]
SLOWEST, FASTEST = 1.0, 300.0
"""Range of angular frequencies [rad/s]."""


def random_disturbances(
    admissible: Admissible,
    steps: int,
    period: float,
    count: int,
    generator: np.random.Generator,
    *,
    nv: int | None = None,
) -> Float[np.ndarray, "count steps n"]:
    """`count` admissible τ_d(t) [N·m], held over each period [s], of every kind of `KINDS` in turn.

    Rates, phases and shares of the joints are random. Square waves, constants, steps and random switching stay on the
    boundary of the admissible set; sines, sums of sines and filtered noise touch it.
    nv: number of joints, for a bound on ‖τ_d‖; raises ArgumentError if it is missing then.
    """
    n = nv if admissible.box is None else len(admissible.box)
    if n is None:
        raise ArgumentError("a bound on ‖τ_d‖ does not give the number of joints; give nv.")
    t = period * np.arange(steps)
    kinds = list(KINDS.values())
    return np.array([kinds[k % len(kinds)](admissible, t, n, generator) for k in range(count)]).reshape(count, steps, n)


def constant(admissible: Admissible, t: Instants, n: int, rng: np.random.Generator) -> Torques:
    """A corner of the box, or a random direction of the ball."""
    return np.tile(admissible.towards(_direction(n, rng)), (len(t), 1))


def square(admissible: Admissible, t: Instants, n: int, rng: np.random.Generator) -> Torques:
    """A square wave per joint, each with its own rate and phase."""
    return admissible.towards(_direction(n, rng) * _signs(np.sin(_angles(t, n, rng))))


def in_step(
    admissible: Admissible, t: Instants, n: int, rng: np.random.Generator, rate: float | None = None
) -> Torques:
    """A square wave of one rate [rad/s] on all joints, in phase or antiphase."""
    rate = float(_rates(1, rng)[0]) if rate is None else rate
    wave = _signs(np.sin(rate * t[:, None] + rng.uniform(0.0, 2.0 * np.pi)))
    return admissible.towards(_direction(n, rng) * wave)


def _step(admissible: Admissible, t: Instants, n: int, rng: np.random.Generator) -> Torques:
    after = t[:, None] >= rng.uniform(0.0, t[-1] if t[-1] > 0.0 else 1.0, n)
    return admissible.towards(np.where(after, _direction(n, rng), _direction(n, rng)))


def _switching(admissible: Admissible, t: Instants, n: int, rng: np.random.Generator) -> Torques:
    """Signs that change at random instants, on average as often as a wave of a random rate."""
    h = t[1] - t[0] if len(t) > 1 else 0.0
    changes = rng.random((len(t), n)) < _rates(n, rng) * h / np.pi
    return admissible.towards(_direction(n, rng) * (1.0 - 2.0 * (np.cumsum(changes, axis=0) % 2)))


def _sine(admissible: Admissible, t: Instants, n: int, rng: np.random.Generator) -> Torques:
    return _touching(admissible, np.abs(_direction(n, rng)) * np.sin(_angles(t, n, rng)))


def _multisine(admissible: Admissible, t: Instants, n: int, rng: np.random.Generator) -> Torques:
    waves = [rng.uniform(0.2, 1.0, n) * np.sin(_angles(t, n, rng)) for _ in range(5)]
    return _touching(admissible, np.sum(waves, axis=0))


def _noise(admissible: Admissible, t: Instants, n: int, rng: np.random.Generator) -> Torques:
    """White noise through a first-order low-pass filter."""
    h = t[1] - t[0] if len(t) > 1 else 1.0
    keep, white = np.exp(-_rates(n, rng) * h), rng.standard_normal((len(t), n))
    filtered = np.zeros((len(t), n))
    for k in range(1, len(t)):
        filtered[k] = keep * filtered[k - 1] + (1.0 - keep) * white[k]
    return _touching(admissible, filtered)


KINDS: dict[str, Callable[..., np.ndarray]] = {
    "constant": constant,
    "square wave": square,
    "square wave in step": in_step,
    "step": _step,
    "random switching": _switching,
    "sine": _sine,
    "multisine": _multisine,
    "filtered noise": _noise,
}
"""Every kind of random disturbance by name."""


def _rates(n: int, rng: np.random.Generator) -> np.ndarray:
    return np.exp(rng.uniform(np.log(SLOWEST), np.log(FASTEST), n))


def _angles(t: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    return t[:, None] * _rates(n, rng) + rng.uniform(0.0, 2.0 * np.pi, n)


def _direction(n: int, rng: np.random.Generator) -> np.ndarray:
    """A random direction without zero components; in a ball, a few joints may dominate it."""
    return rng.choice([-1.0, 1.0], n) * rng.uniform(0.05, 1.0, n) ** 2


def _signs(x: np.ndarray) -> np.ndarray:
    return np.where(x >= 0.0, 1.0, -1.0)


def _touching(admissible: Admissible, signal: np.ndarray) -> np.ndarray:
    """The signal, scaled until each joint's peak, or the norm's, is the bound."""
    if admissible.box is not None:
        peak = np.abs(signal).max(axis=0)
        return np.asarray(admissible.box * signal / np.where(peak > 0.0, peak, 1.0))
    peak = np.linalg.norm(signal, axis=-1).max()
    return np.asarray((admissible.radius or 0.0) * signal / (peak if peak > 0.0 else 1.0))
