"""A law, a network family and a plant as somebody else would write them, each in one file of its own."""

import torch
from torch import nn

from nbs_pin.base.storable import storable
from nbs_pin.controllers.gains import PositiveGains, pd_gains, stored_gains
from nbs_pin.controllers.model_law import ModelLaw
from nbs_pin.dynamics.features import JointFeatures
from nbs_pin.dynamics.lagrangian_network import LagrangianNetwork
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.scales import Scales, stored_scales
from nbs_pin.dynamics.tanh_network import TanhNetwork
from nbs_pin.simulation.dynamics_plant import DynamicsPlant


@storable(parts=("dynamics", "friction"), arrays=stored_gains("kp", "kd"))
class Impedance(ModelLaw):
    """τ = M a_d + C v_d + G − K_p z1 − K_d ż1."""

    def __init__(self, dynamics, *, kp, kd, friction=None):
        super().__init__(dynamics, friction)
        self.gains = PositiveGains(dynamics.nv, kp=kp, kd=kd)

    @classmethod
    def for_robot(cls, robot, *, bandwidth, period):
        dynamics = PinocchioDynamics(robot)
        kp, kd = pd_gains(robot, dynamics, bandwidth=bandwidth, period=period)
        return cls(dynamics, kp=kp, kd=kd)

    def torque(self, q, v, q_ref, v_ref, a_ref):
        kp, kd = self.gains.like(q)
        feedback = kp * self.dynamics.difference(q, q_ref) + kd * (v - v_ref)
        return self.dynamics.reference_torque(q, v, v_ref, a_ref) - feedback


@storable(("widths",), arrays=stored_scales, sequence=tuple)
class DiagonalNetwork(LagrangianNetwork):
    """M̂ = R diag(exp) R + εI: no coupling between joints."""

    def __init__(self, prismatic, *, widths=(16,), epsilon=1e-6, inertia=None, energy=1.0, seed=0):
        super().__init__()
        self.features, self.nv = JointFeatures(prismatic), len(prismatic)
        self.scales = Scales(self.nv, epsilon, inertia, energy)
        sizes = (self.features.size, *widths, self.nv + 1)
        self.network = TanhNetwork(sizes, torch.Generator().manual_seed(seed))

    fit_widths = (8,)

    @property
    def widths(self):
        return tuple(len(bias) for _, bias in self.network.layers()[:-1])

    def mass_matrix(self, q):
        diagonal = nn.functional.softplus(self.network(self.features(q))[..., :-1])
        return torch.diag_embed(self.scales.inertia * diagonal) + self.scales.floor

    def potential(self, q):
        return self.scales.energy * self.network(self.features(q))[..., -1]


class Sticky(DynamicsPlant):
    """Pinocchio's arm by semi-implicit Euler, whatever is asked for."""

    @classmethod
    def for_robot(cls, robot, integrator=None, joint_friction="drop"):
        return cls(PinocchioDynamics(robot), "semi_implicit_euler")
