"""The torque from outside in a run, beside the disturbance that its certificate allows: information, not a verdict."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.units import SLIDING, several, units
from nbs_pin.certificates.certificate import Certificate
from nbs_pin.certificates.energy_balance import LoopSamples
from nbs_pin.dynamics.momentum_observer import MomentumObserver

_OF_BOUND, _OF_TORQUE = 1e-2, 1e-3


class SeenTorque(NamedTuple):
    """What a momentum observer with the certified law's model and friction makes of a run.

    Its estimate is a mean of the past torque from outside, so an admissible disturbance and an exact model keep it
    within the declared bounds, up to the error of the discretisation (docs/theory.md §9). Errors of the model are
    in it.
    """

    torque: Float[np.ndarray, "rows n"]
    """The estimate at every instant [N·m, N]; NaN in rows that are not finite."""
    declared: JointArray
    """Largest |τ_d,i| that the certificate allows [N·m, N]; of a ball, its radius."""
    room: JointArray
    """Errors of differences [N·m, N], which are not told as more than declared."""
    is_ball: bool
    """Whether the certificate bounds ‖τ_d‖ in place of each |τ_d,i|."""
    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    """The unit of every joint's torque."""

    @property
    def largest(self) -> JointArray:
        """Largest |r| of each joint [N·m, N]."""
        return np.asarray(np.nanmax(np.abs(self.torque), axis=0))

    @property
    def size(self) -> float:
        """Largest ‖r‖ [N·m, N]."""
        return float(np.nanmax(np.linalg.norm(self.torque, axis=1)))

    def __str__(self) -> str:
        if self.is_ball:
            unit = several(self.units)
            return f"the momentum shows at most {self.size:.3g} {unit} from outside, of {self.declared[0]:g} declared"
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(self.largest > 0.0, self.largest / self.declared, 0.0)
        worst, more = int(np.argmax(share)), int((self.largest > self.declared + self.room).sum())
        said = f"the momentum shows at most {self.largest[worst]:.3g} {self.units[worst]} from outside on "
        said += f"{self.joint_names[worst]}, of {self.declared[worst]:g} {self.units[worst]} declared"
        return said + (f"; more than declared on {more} of {len(share)} joints" if more else "")


def seen_torque(certificate: Certificate, at: LoopSamples, lost: Bool[np.ndarray, " rows"]) -> SeenTorque:
    """The torque from outside at the instants of one start; `lost` are the rows that are not finite."""
    law, admissible = certificate.controller, certificate.admissible
    observer, kept = MomentumObserver(law.dynamics, friction=law.friction), at.rows(~lost)
    torque = np.full(at.q.shape, np.nan)
    torque[~lost] = observer.estimate(kept.t, kept.q, kept.v, kept.tau)
    slides = [unit == SLIDING.position for unit in certificate.joint_units]
    declared, given = admissible.largest(law.nv), units("torque", slides)
    room = _OF_BOUND * declared + _OF_TORQUE * np.abs(kept.tau).max(axis=0)
    return SeenTorque(torque, declared, room, admissible.box is None, certificate.joint_names, given)
