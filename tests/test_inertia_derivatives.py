"""±∂M/∂q_i against γ_iM and γ_iW in every pose, on arms and on random trees."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nbs_pin.dynamics.rigid_tree import RigidTree
from nbs_pin.inertia.derivatives import inertia_derivatives, rate_bound
from tests.arms import random_tree, robot_of, tree_mass_matrix

ARMS = ("two_link", "three_link", "ur5")
