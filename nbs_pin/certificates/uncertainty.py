"""What is known of the bodies and the friction of the true arm: shares of the model's numbers, and a payload."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from jaxtyping import Float, Int

from nbs_pin.base.arguments import a, check_fields, checked, maybe, number, text
from nbs_pin.dynamics.pseudo_inertia import inertial_parameters
from nbs_pin.robots.carrying import carrying
from nbs_pin.robots.places import place_of, tool_frame
from nbs_pin.robots.robot import ARM, Robot
from nbs_pin.robots.urdf_options import Payload as Load


@dataclass(frozen=True)
class Payload:
    """A body that the model does not include: its mass is at most `mass`, and all of it lies in a ball.

    Raises:
        ArgumentError: If mass or radius is out of range.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.Payload(mass=2.0, radius=0.05)  # up to 2 kg within 5 cm of the arm's end
        Payload(mass=2.0, radius=0.05, link=None)
    """

    mass: float
    """Largest mass [kg]."""
    radius: float = 0.0
    """Radius of the ball about the origin of the link [m]; 0 for a point."""
    link: str | None = None
    """The link that carries it; None takes the arm's end (`places.tool_frame`)."""

    def __post_init__(self) -> None:
        check_fields(
            self, mass=number(above=0.0, unit="kg"), radius=number(least=0.0, most=1e50, unit="m"), link=maybe(text)
        )

    def on(self, robot: Robot) -> Robot:
        """The arm with all of the mass at the origin of the link, besides a load that it carries there."""
        return carrying(robot, [(tool_frame(robot) if self.link is None else self.link, Load(self.mass))])


@dataclass(frozen=True)
class Uncertainty:
    """How far the true arm may differ from the law's model: `certify` then covers every such arm.

    Raises:
        ArgumentError: If a share is not in [0, 1).

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.Uncertainty(inertia=0.05, payload=nbs.Payload(2.0, radius=0.05))
        Uncertainty(inertia=0.05, payload=Payload(mass=2.0, radius=0.05, link=None), viscous=0.0, coulomb=0.0)
    """

    inertia: float = 0.0
    """p: the mass of each body, each coordinate of its centre of mass and each entry of its inertia about that centre,
    in the frame of its joint, are within ±p times the model's."""
    payload: Payload | None = None
    """A body on top of these."""
    viscous: float = 0.0
    """Share by which the viscous friction of each joint may differ from that stated."""
    coulomb: float = 0.0
    """Share by which the Coulomb friction of each joint may differ from that stated."""

    def __post_init__(self) -> None:
        share, payload = number(least=0.0, below=1.0), a(Payload, "a Payload, such as Payload(2.0, radius=0.05)")
        check_fields(self, inertia=share, payload=maybe(payload), viscous=share, coulomb=share)

    @property
    def of_bodies(self) -> bool:
        """Whether bodies, and not friction alone, are uncertain."""
        return self.inertia > 0.0 or self.payload is not None

    @checked(robot=ARM, model=a(pin.Model, "the Pinocchio model of that arm, such as robot.model"))
    def errors(self, robot: Robot, model: pin.Model) -> "BodyErrors":
        """The errors that bodies of `model`, a model of the arm, may have.

        Raises:
            ArgumentError: If the arm has no such link.
        """
        found = [_shares(body, self.inertia) for body in list(model.inertias)[1:]]
        bodies = [np.full(len(x), i) for i, x in enumerate(found)]
        if self.payload is not None:
            joint, at = place_of(robot, self.payload.link)
            found.append(_loaded(self.payload, at))
            bodies.append(np.full(len(found[-1]), joint - 1))
        body, matrices = np.concatenate(bodies), np.concatenate(found)
        kept = np.abs(matrices).max(axis=(1, 2)) > 0.0
        return BodyErrors(body[kept], inertial_parameters(matrices[kept]), matrices[kept])

    def __str__(self) -> str:
        texts = [f"bodies within ±{100.0 * self.inertia:g} %"] if self.inertia else []
        if self.payload is not None:
            texts.append(f"a payload of at most {self.payload.mass:g} kg within {self.payload.radius:g} m")
        for name in ("viscous", "coulomb"):
            share = getattr(self, name)
            texts += [f"{name} friction within ±{100.0 * share:g} %"] if share else []
        return ", ".join(texts) or "nothing unknown"


@dataclass(frozen=True, eq=False)
class BodyErrors:
    """Directions e_g of the parameters: those of every arm admitted differ from the model's by Σ s_g e_g, |s_g| ≤ 1."""

    body: Int[np.ndarray, " g"]
    """Index of the body that each direction changes."""
    parameters: Float[np.ndarray, "g 10"]
    """Per direction mass, first moment and inertia about the joint's origin, in Pinocchio's order and frames."""
    pseudo: Float[np.ndarray, "g 4 4"]
    """The same as pseudo-inertias."""


def _shares(body: pin.Inertia, p: float) -> Float[np.ndarray, "g 4 4"]:
    """The directions of a body, numbers within ±p (docs/certificates.md §14).

    With c̃ = (c, 1) the pseudo-inertia is m c̃c̃ᵀ + J(I). The mass takes s_0 and each coordinate of c its own s_k; the
    terms with s_0 s_k and s_0 s_j s_k are covered by the factor 1 + p.
    """
    mass, centre, inertia = float(body.mass), np.array(body.lever), np.array(body.inertia)
    place, moved = np.append(centre, 1.0), np.zeros((3, 4))
    moved[:, :3] = np.diag(p * centre)
    found = [p * mass * np.outer(place, place)]
    found += [(1.0 + p) * mass * (np.outer(x, place) + np.outer(place, x)) for x in moved]
    for j in range(3):
        for k in range(j + 1):
            both = np.outer(moved[j], moved[k])
            found.append((1.0 + p) * mass * (both if j == k else both + both.T))
            found.append(p * _pseudo_of_entry(inertia, j, k))
    return np.array(found)


def _pseudo_of_entry(inertia: Float[np.ndarray, "3 3"], j: int, k: int) -> Float[np.ndarray, "4 4"]:
    """The pseudo-inertia of the entries (j, k) and (k, j) of an inertia about the centre of mass."""
    part, out = np.zeros((3, 3)), np.zeros((4, 4))
    part[j, k] = part[k, j] = inertia[j, k]
    out[:3, :3] = 0.5 * np.trace(part) * np.eye(3) - part
    return out


def _loaded(payload: Payload, at: Float[np.ndarray, "3"]) -> Float[np.ndarray, "10 4 4"]:
    """The directions of a payload in a ball about `at`: the mean of (at + ρ, 1)(at + ρ, 1)ᵀ over it, ‖ρ‖ ≤ radius."""
    place, axes = np.append(at, 1.0), payload.radius * np.eye(4)[:3]
    found = [np.outer(place, place)]
    found += [np.outer(x, place) + np.outer(place, x) for x in axes]
    for j in range(3):
        for k in range(j + 1):
            both = np.outer(axes[j], axes[k])
            found.append(both if j == k else 0.5 * (both + both.T))
    return payload.mass * np.array(found)
