"""Models that `fit` makes, by name."""

from nbs_pin.base.registry import Entry
from nbs_pin.dynamics.registry import NETWORKS

_FITTERS = "nbs_pin.identification.fitters"
MODELS: dict[str, Entry] = {
    "chain": Entry(f"{_FITTERS}:fit_rigid_tree"),
    **dict.fromkeys(NETWORKS, Entry(f"{_FITTERS}:fit_family")),
    "residual": Entry(f"{_FITTERS}:fit_residual"),
    "identified": Entry(f"{_FITTERS}:fit_identified"),
}
"""Rigid trees and networks, which need no description of the arm; a network that corrects the arm's nominal model; and
inertias put into its URDF's geometry."""
