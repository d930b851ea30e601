"""Records passed between kernels; fields are contiguous float64 vectors (n,) unless stated otherwise."""

from collections import namedtuple
from typing import TypeAlias

import numpy as np

Vec: TypeAlias = np.ndarray
Mat: TypeAlias = np.ndarray

State = namedtuple("State", "q v")
"""Where an arm is and how it moves; or the cotangents of that."""
Target = namedtuple("Target", "q v a")
"""The reference's position, velocity and acceleration."""
Dual = namedtuple("Dual", "value rate")
"""A vector and its rate, an error z and ż or ∇Φ(z) and ∇²Φ(z) ż; or the cotangents of these."""
Tracking = namedtuple("Tracking", "z1 dz1 v v_ref a_ref")
"""What a law reads of a state and its target."""
Signals = namedtuple("Signals", "v_r a_r feedback")
"""What a law adds to the model, τ = M(q) a_r + C(q, v) v_r + G(q) + feedback; or the cotangents of that."""
Memory = namedtuple("Memory", "integral derivative")
"""What a PID remembers: integral torque [N·m] and filtered ż1 [rad/s]; or the cotangents of that."""
Potential = namedtuple("Potential", "n depth code widest parameter value scale tangent stiffness")
"""A packed potential before its layers: integers, σ's parameter and f(0) (1,), R, ∇f(0), and the rows of 2S."""
Damping = namedtuple("Damping", "n depth code widest m inverse_ceiling scale floor")
"""A packed damping before its layers: integers, m and 1/ceiling (1,), R, and the rows of D₀."""
Motion = namedtuple("Motion", "q v w a")
"""What the torque M(q) a + C(q, v) w + G(q) of a tree depends on; or the cotangents of that."""
PID = namedtuple("PID", "kp ki kd limit filter_time wraps")
"""A PID's weights."""
