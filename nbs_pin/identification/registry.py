"""The models that `fit` can make, by name."""

from nbs_pin.base.registry import Entry
from nbs_pin.dynamics.registry import NETWORKS

_FITTERS = "nbs_pin.identification.fitters"
MODELS: dict[str, Entry] = {
    "chain": Entry(f"{_FITTERS}:fit_rigid_tree"),
    **dict.fromkeys(NETWORKS, Entry(f"{_FITTERS}:fit_family")),
    "residual": Entry(f"{_FITTERS}:fit_residual"),
    "identified": Entry(f"{_FITTERS}:fit_identified"),
}
"""Rigid trees and networks, which need no URDF; a network that corrects the nominal model of a URDF; and inertial
parameters for the geometry of a URDF."""
