"""A law whose model adapts to the arm: an unknown load, links, friction, rotors, constant torques."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import nn

from nbs_pin.base.arguments import BANDWIDTH, PERIOD, SEED, a, checked, joints, maybe, number, numbers, text, texts
from nbs_pin.base.arrays import (
    Array,
    Vectors,
    array_namespace,
    as_vectors,
    constant_like,
    finite_result,
    is_torch_array,
    matvec,
)
from nbs_pin.base.checks import PerJoint, told
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.known_code import defines, known_code
from nbs_pin.base.records import Reference, Run
from nbs_pin.base.shown import joints_told
from nbs_pin.base.storable import storable
from nbs_pin.controllers.adapting_model import AdaptingModel
from nbs_pin.controllers.bearable import Bearable, rotors_of
from nbs_pin.controllers.compiled_adaptive import (
    MEMORY,
    AdaptiveMemory,
    CompiledAdaptiveLaw,
    checked_period,
    read_memory,
)
from nbs_pin.controllers.computed_torque import ComputedTorque
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.estimates import Estimate, estimate_of
from nbs_pin.controllers.excitation import excitation
from nbs_pin.controllers.exported import Parts
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.controllers.model_law import ModelLaw
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.controllers.passive_outputs import output_of, signals_of
from nbs_pin.controllers.unknowns import (
    ADAPTS,
    Carrier,
    UnknownBody,
    UnknownNumber,
    Unknowns,
    unknown_links,
    unknown_load,
    unknown_numbers,
    unknown_rotors,
)
from nbs_pin.controllers.update_rates import TrainedRates, UsualMotions, update_rates
from nbs_pin.dynamics.friction import FRICTION, JointFriction
from nbs_pin.dynamics.pinocchio_tree import pack_model
from nbs_pin.dynamics.provider import MODEL, DynamicsProvider
from nbs_pin.dynamics.rigid_tree import RigidTree
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.tree_layout import BASE, BODY, MASS
from nbs_pin.robots.robot import ARM, Robot

_LOAD, _RADIUS = 0.25, 0.1  # largest load as a share of the arm's mass; where it lies [m]
_TRANSITION = 0.01  # speed scale of Coulomb friction where the law feeds none forward [rad/s]


@known_code
@storable(
    (
        *("adapts", "frame", "links", "load_mass", "load_radius", "load_across", "largest_rotor"),
        *("gain", "period", "output_rate"),
    ),
    parts=("law",),
    arrays=lambda t: {"rates": t["speed.rates"].numpy(force=True), "leak": float(t["speed.leak"])},
)
class AdaptiveLaw(Controller, nn.Module):
    """A law whose model learns what it does not know while the arm moves.

    τ = law + Y(q, v, v_r, a_r)(π̂ − π_model). Every unknown body has P̂ = K X̂ Kᵀ with X̂ = (1 + e^−Q)⁻¹, which every
    symmetric Q makes a body that can exist, and Q̇ = −γ KᵀLK − σ(Q − Q₀), tr(LP) = z2ᵀY(P). With the Fermi–Dirac
    divergence d of X from X̂, V_a = V + Σ d/γ decreases as V does where the model is exact, for every weight of the law
    (docs/theory.md §10). While a torque is beyond the effort limit of
    the arm the estimates wait.

    Args:
        law: A law with a Lyapunov function, such as NeuralBackstepping, with the model that is believed at first; or PD
            or ComputedTorque, which adapt "offsets" alone.
        adapts: Any of "load", "links", "friction", "rotors", "offsets" (constant torques, of ComputedTorque constant
            accelerations: integral action).
        frame: Link that carries the load; None takes the arm's end.
        links: Joints whose bodies adapt with "links"; none takes all.
        load_mass: Largest load [kg]; None takes a quarter of the arm's mass.
        load_radius: The load lies within this distance of the frame's origin [m]; None takes 0.1 m.
        load_across: Across the axis of the joint that carries it, the load lies within this distance of the frame's
            origin [m], in the ellipsoid of both. None takes `load_radius`.
        largest_rotor: Largest rotor inertia of every joint [kg·m², kg]; None takes a quarter of the arm's largest. None
            of these four takes less where the model's inertia is so small that the sampled law would shake the arm
            with estimates of that size (docs/theory.md §10); what is given and too large for it warns.
        gain: Speed of adaptation, the share of the damping's work that a sampled step costs at most in usual motions.
            Training raises γ by less than 1/gain (`update_rates.TrainedRates`).
        leak: σ [1/s], at which estimates return to the first ones; 0 for none.
        period: Longest control period h [s] that γ is stable for.
        rates: γ of every unknown, in place of those that `gain` gives; for these `gain` only limits training.
        output_rate: ε or λ [1/s] of PD and ComputedTorque (`passive_outputs.py`), (n,); None takes it from their gains.

    Raises:
        ArgumentError: For a law without an arm or a passive output, an unknown name, bounds of what does not adapt, or
            a number out of range.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("panda")
        >>> law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(robot), ["load", "friction"], load_mass=4.0)
        >>> memory = law.initial_memory([0.0] * 7)
        >>> round(abs(float(law.estimate(memory).load_mass)), 6)
        0.0
    """

    @checked(
        law=a(ModelLaw, "a law with a model, such as NeuralBackstepping.for_robot(robot)"),
        adapts=texts,
        frame=maybe(text),
        links=texts,
        load_mass=maybe(number(above=0.0, unit="kg")),
        load_radius=maybe(number(above=0.0, most=100.0, unit="m")),
        load_across=maybe(number(above=0.0, most=100.0, unit="m")),
        largest_rotor=maybe(joints(least=0.0, unit="kg·m²")),
        gain=number(above=0.0, below=1.0),
        leak=number(least=0.0, unit="1/s"),
        period=PERIOD,
    )
    def __init__(
        self,
        law: ModelLaw,
        adapts: Sequence[str] = ("load",),
        *,
        frame: str | None = None,
        links: Sequence[str] = (),
        load_mass: float | None = None,
        load_radius: float | None = None,
        load_across: float | None = None,
        largest_rotor: PerJoint | None = None,
        gain: float = 0.6,
        leak: float = 0.0,
        period: float = 0.001,
        rates: Any = None,
        output_rate: Any = None,
    ) -> None:
        super().__init__()
        robot = law.dynamics.robot
        if robot is None:
            raise ArgumentError("AdaptiveLaw was given a law whose model has no arm; give one made for a robot.")
        wrong = [name for name in adapts if name not in ADAPTS]
        if wrong or not len(adapts) or len(set(adapts)) < len(adapts):
            raise ArgumentError(f"AdaptiveLaw: adapts is {told(list(adapts))}; give some of {', '.join(ADAPTS)}, once.")
        if not isinstance(law, LyapunovLaw) and tuple(adapts) != ("offsets",):
            raise ArgumentError(
                f"AdaptiveLaw: a {type(law).__name__} was given adapts={told(list(adapts))}, expected ['offsets'] for a"
                " law without a Lyapunov function; give that, or NeuralBackstepping."
            )
        self._refuse_unused(adapts, frame=frame, load_mass=load_mass, load_radius=load_radius, load_across=load_across)
        self._refuse_unused(adapts, links=links or None, largest_rotor=largest_rotor)
        self.law, self.robot = law, robot
        self.adapts, self.frame, self.links = tuple(map(str, adapts)), frame, tuple(map(str, links))
        self.gain, self.period = gain, period
        self.load_mass, self.load_radius, self.load_across = load_mass, load_radius, load_across
        self.largest_rotor = None if largest_rotor is None else rotors_of(robot, largest_rotor)
        if isinstance(law, LyapunovLaw):
            self._complete(Bearable(law, self._believed, period))
        self.output = output_of(law, output_rate)
        self.output_rate = self.output.rate
        self.speed = TrainedRates(self._rates(rates), leak, gain)

    @classmethod
    @checked(robot=ARM, dynamics=maybe(MODEL), bandwidth=BANDWIDTH, period=PERIOD, friction=maybe(FRICTION), seed=SEED)
    def for_robot(
        cls,
        robot: Robot,
        dynamics: DynamicsProvider | None = None,
        *,
        adapts: Sequence[str] = ("load", "friction", "rotors"),
        bandwidth: float = 8.0,
        period: float = 0.001,
        friction: JointFriction | None = None,
        seed: int = 0,
    ) -> "AdaptiveLaw":
        """An adaptive law around `NeuralBackstepping.for_robot` with the same arguments."""
        law = NeuralBackstepping.for_robot(
            robot, dynamics, bandwidth=bandwidth, period=period, friction=friction, seed=seed
        )
        return cls(law, adapts, period=period)

    @staticmethod
    def _refuse_unused(adapts: Sequence[str], **given: Any) -> None:
        """Raises ArgumentError for a bound of what does not adapt."""
        for name, value in given.items():
            of = "links" if name == "links" else "rotors" if name == "largest_rotor" else "load"
            if value is not None and of not in adapts:
                raise ArgumentError(
                    f'AdaptiveLaw: {name} was given with adapts={told(list(adapts))}, expected "{of}" among these; add'
                    f" it, or leave {name} out."
                )

    def _complete(self, bears: Bearable) -> None:
        """Set the largest load and rotors that were not given; warns of those given that the law may not bear."""
        if "load" in self.adapts:
            carrier = Carrier.of(self.robot, self.frame)
            if self.load_mass is None:
                mass = sum(body.mass for body in list(self.robot.model.inertias)[1:])
                self.load_mass = bears.mass(carrier, _LOAD * mass)
            if self.load_radius is None:
                self.load_radius = bears.radius(carrier, self.load_mass, _RADIUS)
            if self.load_across is None:
                self.load_across = bears.across(carrier, self.load_mass, self.load_radius)
            bears.warn_of_load(carrier, self.load_mass, self.load_radius, self.load_across)
        if "rotors" in self.adapts:
            self.largest_rotor = bears.rotors() if self.largest_rotor is None else self.largest_rotor
            bears.warn_of_rotors(self.largest_rotor)

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self.law.nv

    def _facts(self) -> Iterable[str]:
        return self.robot.name, joints_told(self.nv), f"{type(self.law).__name__} adapts {', '.join(self.adapts)}"

    @cached_property
    def unknowns(self) -> Unknowns:
        """What adapts, with the bounds and the first estimates of it."""
        robot, tree, friction = self.robot, self._believed, self.law.friction
        bodies: list[UnknownBody] = []
        own: list[UnknownNumber] = []
        if self.load_mass is not None and self.load_radius is not None and self.load_across is not None:
            carrier = Carrier.of(robot, self.frame)
            largest = carrier.largest(self.load_mass, self.load_radius, self.load_across)
            bodies.append(unknown_load(tree, carrier, largest))
        if "links" in self.adapts:
            carrying = [body.joint for body in bodies]  # its own body adapts with the load
            bodies += [body for body in unknown_links(robot, tree, self.links) if body.joint not in carrying]
        for kind in self.adapts:
            if kind == "rotors" and self.largest_rotor is not None:
                own += unknown_rotors(self.law, tree, self.largest_rotor)
            elif kind in ("friction", "offsets"):
                own += unknown_numbers(self.law, kind, self.period)
        return Unknowns(tuple(bodies), tuple(own), _TRANSITION if friction is None else friction.transition)

    @cached_property
    def _believed(self) -> Packed:
        """The rigid tree of the model; raises ArgumentError unless it is one with the arm's own geometry."""
        tree, own = self.law.dynamics.packed_tree(), pack_model(self.robot.model)
        same = tree is not None and np.array_equal(tree.layout, own.layout)
        if tree is None or not same or not np.allclose(_geometry(tree), _geometry(own), rtol=0.0, atol=1e-12):
            kind = type(self.law.dynamics).__name__
            raise ArgumentError(f"AdaptiveLaw cannot adapt a {kind}; give a law with a rigid model of the same arm.")
        return tree

    @cached_property
    def _tree(self) -> tuple[RigidTree, np.ndarray]:
        return RigidTree.of(self._believed), -self._believed.weights[:3]

    def _rates(self, rates: Any) -> np.ndarray:
        if rates is None:
            return update_rates(self.law, self.output, self.unknowns, *self._tree, gain=self.gain, period=self.period)
        count = len(self.unknowns.bodies) + len(self.unknowns.numbers)
        return np.array(numbers(count, least=0.0, unit="1/J")("AdaptiveLaw: rates", rates))

    @property
    def rates(self) -> Float[np.ndarray, " unknowns"]:
        """γ of every unknown [1/J]."""
        return np.asarray(self.speed.value(numpy=True)[0])

    @property
    def leak(self) -> float:
        """σ [1/s]."""
        return float(self.speed.value(numpy=True)[1])

    def step_cost(self) -> float:
        """The share of the damping's work that a step of `period` with `rates` costs at most in usual motions.

        `gain` where these follow from it and the law was not trained since (docs/theory.md §10).
        """
        motions = UsualMotions.of(self.law, self.output, self.unknowns, *self._tree)
        return self.period * motions.cost(self.rates)

    def initial_memory(self, q: Vectors) -> AdaptiveMemory:
        """The first estimates, with the array type and the leading axes of q."""
        (q,) = as_vectors(self.nv, q=q)
        zero = 0.0 * q
        return AdaptiveMemory(constant_like(q, self.unknowns.start) + zero[..., :1], zero, zero)

    @checked(memory=MEMORY)
    def recorded(self, memory: AdaptiveMemory) -> Array:
        """The duals."""
        return memory.duals

    def estimates(self, recorded: np.ndarray) -> tuple[np.ndarray, list[str]]:
        """`Estimate.values` of these duals, and its names."""
        (duals,) = as_vectors(len(self.unknowns.start), recorded=recorded)
        found = estimate_of(self.robot, self._believed, self.unknowns, _plain(duals))
        return found.values, found.names

    def step(
        self, memory: AdaptiveMemory, q: Vectors, v: Vectors, reference: Reference, period: float
    ) -> tuple[Vectors, AdaptiveMemory]:
        """τ [N·m] for the next period [s], and the estimates after it; differentiable for tensors.

        Raises:
            ArgumentError: For a longer period than the law's own, for which γ may not be stable, or wrong shapes.
        """
        period = checked_period(period, self.period)
        duals, given = read_memory(memory, self.unknowns.start.size, self.nv, q, v, reference)
        last, before, q, v, *aim = given
        v_r, a_r, output = signals_of(self.law, self.output, q, v, *aim)
        now = self._now(duals, q, v, v_r, a_r)
        tau = self.law.torque(q, v, *aim) + now.torque()
        if isinstance(self.law, ComputedTorque):
            tau = tau + matvec(self.law.dynamics.mass_matrix(q), now.accelerations())
        tau = finite_result("the torque", tau, *given, duals)
        xp = array_namespace(q)
        read = xp.isfinite(before)
        free = xp.all((abs(tau) <= constant_like(q, self.robot.effort_limit)) & read, axis=-1)[..., None]
        moved = now.moved(xp.where(read, before, 0.0 * output), *self.speed.like(q), period)
        after = xp.where(free, moved, now.duals.flat())
        return tau, AdaptiveMemory(after, output, last)

    def _now(self, duals: Array, q: Array, v: Array, v_r: Array, a_r: Array) -> AdaptingModel:
        return AdaptingModel.of(self.unknowns, *self._tree, duals, q, v, v_r, a_r)

    def estimate(self, believed: AdaptiveMemory | Run | Array | None = None) -> Estimate:
        """What is believed of the unknowns with this memory, after a run, or at every instant of one.

        Args:
            believed: A memory; a run with one start, whose last estimates are returned with how far each may be off,
                as its second half has shown (docs/theory.md §10); or `run.estimates`, values in the units of the arm,
                not duals. None is the start.

        Raises:
            ArgumentError: For another number of values, or a run of several starts or without estimates.

        Example:
            >>> import nbs_pin as nbs
            >>> robot = nbs.load_robot("two_link")
            >>> law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(robot), load_mass=1.0)
            >>> plant = nbs.DynamicsPlant.for_robot(robot.with_payload("tip", 0.5))
            >>> run = nbs.simulate(plant, law, nbs.Sinusoid.for_robot(robot), 4.0, 0.001)
            >>> found = law.estimate(run)
            >>> bool(abs(found.load_mass - 0.5) < 3.0 * found.deviation[0]), len(found.unexcited) > 0
            (True, True)
        """
        if isinstance(believed, Run):
            return self._after(believed)
        known = self.robot, self._believed, self.unknowns
        if believed is None or isinstance(believed, AdaptiveMemory):
            given = self.unknowns.start if believed is None else believed.duals
            (duals,) = as_vectors(len(self.unknowns.start), duals=given)
            return replace(estimate_of(*known, _plain(duals)), friction=self.law.friction)
        (values,) = as_vectors(len(self.unknowns.start), believed=believed)
        return Estimate(*known, _plain(values), friction=self.law.friction)

    def _after(self, run: Run) -> Estimate:
        """The last estimates of a run, and how far they may be off."""
        if run.estimates is None or run.q.ndim != 2 or run.nv != self.nv:
            has = "no estimates" if run.estimates is None else f"q of shape {run.q.shape}"
            raise ArgumentError(
                f"estimate was given a run with {has}, expected one motion of this law, q of shape (rows, {self.nv});"
                " give that, or run.estimates."
            )
        last = self.estimate(run.estimates[-1])
        seen = excitation(self.law, self.output, self.unknowns, *self._tree, run, last.names)
        return replace(last, deviation=seen.deviation, unexcited=seen.unexcited)

    def compile(self) -> Controller:  # type: ignore[override]  # torch.nn.Module has another compile
        """The law as machine code (`Controller.compile`); itself for a subclass, or around a law that has none."""
        if not (defines(self, "compile") and self.law.packable):
            return self
        settings = *self.speed.settled(), self.period, self.output
        return CompiledAdaptiveLaw(self.law.packed_law(), self._believed, self.unknowns, *settings, self.robot)

    def parts_in_c(self) -> Parts:
        """The law inside, the model that it begins with, and what adapts; raises ArgumentError for a subclass."""
        if not defines(self, "parts_in_c"):
            return super().parts_in_c()
        adapting = self.unknowns.adapting(*self.speed.settled(), self.output, self.period)
        return Parts(self.law.packed_law(), self._believed, self.robot, adapting)


def _plain(x: Array) -> np.ndarray:
    """A numpy array of the same numbers."""
    return np.asarray(x.numpy(force=True) if is_torch_array(x) else x, dtype=float)


def _geometry(tree: Packed) -> np.ndarray:
    """Gravity and the placements of the joints."""
    return np.append(tree.weights[:BASE], tree.weights[BASE:].reshape(-1, BODY)[:, :MASS])
