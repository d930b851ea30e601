"""Structure is read from the object, not believed: every broken controller and model is caught, no sound one is."""

import re
from dataclasses import replace
from functools import reduce
from pathlib import Path

import numpy as np
import pytest
import torch

from nbs_pin.accuracy.mismatch import Mismatch, violation_chance
from nbs_pin.base.claims import Label
from nbs_pin.base.exceptions import CertificateRefused
from nbs_pin.base.rounding import least_eigenvalue
from nbs_pin.benchmarks.serial_chains import serial_chain
from nbs_pin.certificates.margins import check_box
from nbs_pin.certificates.model_error import check_fit
from nbs_pin.certificates.model_structure import check_model
from nbs_pin.certificates.structure import check_structure
from nbs_pin.controllers.activations import Activation, SmoothedReLU, Squareplus
from nbs_pin.controllers.computed_torque import ComputedTorque
from nbs_pin.controllers.convex import FICNN
from nbs_pin.controllers.damping import Damping
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping, paper_controller
from nbs_pin.controllers.part_claims import DAMPING
from nbs_pin.controllers.pd import PD
from nbs_pin.controllers.pid import PID
from nbs_pin.controllers.potential import Potential
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.dynamics.chain import Chain
from nbs_pin.dynamics.cholesky import CholeskyNetwork
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.identified import IdentifiedDynamics
from nbs_pin.dynamics.lagrangian import LagrangianDynamics
from nbs_pin.dynamics.picnn import PICNN, HomogenisedPicnn, PaperPicnn
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.residual import ResidualDynamics, ResidualNetwork
from nbs_pin.dynamics.unconstrained import UnconstrainedLagrangian
from nbs_pin.motions.references import Sinusoid
from nbs_pin.robots.robot import load_robot
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.storage.checkpoints import load, save
from nbs_pin.training.train import train
from tests.test_networks import randomise

ROBOT, OTHER = load_robot("three_link"), load_robot("two_link")
GANTRY = Path(__file__).parent / "data" / "gantry.urdf"
SEEDS = range(3)
TURNING = [False] * 3
"""Whether the joints of `ROBOT` slide."""


def law(form="smooth", **settings) -> NeuralBackstepping:
    return NeuralBackstepping.for_robot(ROBOT, potential=form, bandwidth=4.0, **settings)


def by_hand(seed, form="smooth", **parts) -> NeuralBackstepping:
    """A controller with a potential or a damping of one's own, or another law."""
    kind = parts.pop("kind", NeuralBackstepping)
    potential = parts.pop("potential", Potential(np.eye(3), form=form, seed=seed))
    damping = parts.pop("damping", Damping(3, floor=np.eye(3), seed=seed))
    return kind(parts.pop("dynamics", PinocchioDynamics(ROBOT)), potential, damping, **parts)


def believing(dynamics) -> NeuralBackstepping:
    return by_hand(0, dynamics=dynamics)


def learned_by(network) -> NeuralBackstepping:
    return believing(LagrangianDynamics(network))


def with_tensor(module, name, change):
    """The module with one parameter or buffer changed in place."""
    with torch.no_grad():
        tensor = module.get_parameter(name) if name in dict(module.named_parameters()) else module.get_buffer(name)
        tensor.copy_(change(tensor))
    return module


def with_attribute(owner, name, value):
    """The object with one attribute, by its dotted name, replaced even if it is frozen."""
    *path, last = name.split(".")
    part = reduce(getattr, path, owner)
    (setattr if isinstance(part, torch.nn.Module) else object.__setattr__)(part, last, value)
    return owner


def labels(controller) -> set[Label]:
    return {claim.label for claim in check_structure(controller).claims}


# Broken controllers, each by a seed.


def negative_weight(seed):
    """W^(y) of either sign reaches the network as it is."""
    broken = with_attribute(law("paper", seed=seed), "potential.network._nonnegative", lambda weight: weight)
    return with_tensor(broken, f"potential.network.wy{1 + seed % 3}", lambda w: w - 0.1)


def biased_paper(seed):
    broken = by_hand(seed, "paper")
    broken.potential.network = FICNN(3, (8, 8), SmoothedReLU(), biases=True, nonnegative=torch.relu)
    randomise(broken.potential.network, seed)
    broken.potential.network._nonnegative = abs
    return with_tensor(broken, "potential.network.b2", lambda b: abs(b) + 0.1)


def asymmetric(seed):
    name = ("potential.stiffness", "damping.floor")[seed % 2] + ".nominal"
    return with_tensor(law(seed=seed), name, lambda s: s + 0.01 * torch.ones(3, 3).triu(1 + seed % 2))


def stiffness(matrix, seed):
    return with_tensor(law(seed=seed), "potential.stiffness.nominal", lambda s: torch.from_numpy(matrix))


def indefinite_stiffness(seed):
    root = np.random.default_rng(seed).normal(size=(3, 3))
    return stiffness(root + root.T - 3.0 * np.eye(3), seed)


def singular_stiffness(seed):
    root = np.random.default_rng(seed).normal(size=(3, 2))
    return stiffness(root @ root.T, seed)


def not_a_number(seed):
    broken = law(seed=seed)
    names = [name for name, _ in (*broken.named_parameters(), *broken.named_buffers()) if "share" not in name]
    name = names[np.random.default_rng(seed).integers(len(names))]

    def change(x):
        x = x.clone()
        x.view(-1)[-1] = (torch.nan, torch.inf)[seed % 2]
        return x

    return with_tensor(broken, name, change)


class Shape(Activation):
    """σ, σ', σ'' as they are given."""

    def __init__(self, *parts):
        self.parts = parts

    def derivatives(self, x):
        return tuple(part(x) for part in self.parts)


def sigmoid(x):
    return 1.0 / (1.0 + np.exp(-x)) if isinstance(x, np.ndarray) else torch.sigmoid(x)


def tanh(x):
    return 2.0 * sigmoid(2.0 * x) - 1.0


ARTANH = Shape(tanh, lambda x: 1.0 - tanh(x) ** 2, lambda x: -2.0 * tanh(x) * (1.0 - tanh(x) ** 2))
SQUARE = Shape(lambda x: x * x, lambda x: 2.0 * x, lambda x: 0.0 * x + 2.0)
RELU = Shape(lambda x: x * (x > 0.0), lambda x: 1.0 * (x > 0.0), lambda x: 0.0 * x)
SWISH = Shape(
    lambda x: x * sigmoid(x),
    lambda x: sigmoid(x) * (1.0 + x * (1.0 - sigmoid(x))),
    lambda x: sigmoid(x) * (1.0 - sigmoid(x)) * (2.0 + x * (1.0 - 2.0 * sigmoid(x))),
)
EXPONENTIAL = Shape(lambda x: 2.0**x, lambda x: np.log(2.0) * 2.0**x, lambda x: 0.5 * 2.0**x)
LEAKY = Shape(lambda x: 0.5 * (x + (x * x + 1.0) ** 0.5), lambda x: 0.5 + 0.0 * x, lambda x: 0.0 * x)


UNSOUND = (ARTANH, SQUARE, RELU, SWISH, EXPONENTIAL, LEAKY)


def activated(activation, seed=0):
    return by_hand(seed, potential=Potential(np.eye(3), widths=(8, 8), activation=activation, seed=seed))


def negative_scale(seed):
    part = ("potential", "damping")[seed % 2]
    return with_tensor(law(seed=seed), f"{part}.scale", lambda r: r * torch.tensor([1.0, -1.0, 0.0]))


def negative_rate(seed):
    return with_tensor(law(seed=seed), "rate.nominal", lambda x: x * torch.tensor([1.0, (-1.0, 0.0, -1e-9)[seed], 1.0]))


def paper_damping(seed, m):
    return by_hand(seed, damping=Damping(3, form="paper", m=m, seed=seed))


def bad_share(seed):
    gain = ("rate", "potential.stiffness", "damping.floor")[seed]
    return with_tensor(law(seed=seed), f"{gain}.least_share", lambda s: 0.0 * s + (1.0, -0.5, 1.5)[seed])


def another_law(seed):
    model, one = PinocchioDynamics(ROBOT), np.ones(3)
    return (
        PD(model, kp=one, kd=one, feedforward="reference"),
        ComputedTorque(model, kp=one, kd=one),
        PD(model, kp=one, kd=one, feedforward="gravity"),
        PID(kp=one, ki=one, kd=one, effort_limit=one),
        law().compile(),
        "nbs",
    )[seed]


def with_torque(extra):
    """A law that adds a torque of its own, extra(law, errors, q)."""

    class Other(NeuralBackstepping):
        def torque(self, q, *rest):
            return super().torque(q, *rest) + extra(self, self.errors(q, *rest), q)

    return Other


PUSHING_AWAY = with_torque(lambda law, e, q: 2.0 * law.damping.force(e.z2))
WITHOUT_GRAVITY = with_torque(lambda law, e, q: -law.dynamics.gravity(q))
SOFTER = with_torque(lambda law, e, q: -e.z2)  # adds dissipation: sound, but not by structure


def patched_torque(seed):
    broken = law(seed=seed)
    torque = broken.torque
    broken.torque = lambda *x: (1.0 + 0.5 * seed) * torque(*x)
    return broken


class Scaled(Potential):
    """Φ, ∇Φ and ∇²Φ dz, each times a factor."""

    factors = (1.0, 1.0, 1.0)

    def terms(self, z, dz):
        return tuple(factor * x for factor, x in zip(self.factors, super().terms(z, dz), strict=True))


class Dented(FICNN):
    def terms(self, x, dx):
        value, gradient, product = super().terms(x, dx)
        return value - 5.0 * (x * x).sum(-1), gradient - 10.0 * x, product - 10.0 * dx


def another_potential(seed):
    if seed < 2:
        factors = ((-1.0, -1.0, -1.0), (1.0, 1.0, 0.5))[seed]
        return by_hand(seed, potential=with_attribute(Scaled(np.eye(3)), "factors", factors))
    broken = by_hand(seed)
    broken.potential.network.__class__ = Dented
    return broken


class Driving(Damping):
    def force(self, z):
        return -super().force(z)


class Indefinite(Damping):
    def matrix(self, z):
        return super().matrix(z) - 4.0 * np.eye(self.nv)

    def force(self, z):
        return super().force(z) - 4.0 * z


class SameDamping(Damping):
    """Nothing another, which is not known from outside."""

    def force(self, z):
        return super().force(z)


class Stribeck(JointFriction):
    def torque(self, v):
        return super().torque(v) * np.exp(-abs(v))


def bad_friction(seed):
    if seed == 2:
        return by_hand(0, friction=Stribeck(np.ones(3), np.ones(3)))
    friction = JointFriction(np.ones(3), np.ones(3))
    return by_hand(seed, friction=with_attribute(friction, ("viscous", "coulomb")[seed], -np.ones(3)))


# Broken models.


def no_floor_in_mass(seed):
    """ε at or below zero in each family."""
    network = (CholeskyNetwork(TURNING), HomogenisedPicnn(TURNING), Chain(ROBOT.parents, ROBOT.prismatic))[seed]
    if seed == 2:
        network.epsilon = -1e-3
    else:
        with_tensor(network, "scales.epsilon", lambda e: (0.0, -1.0)[seed] * e)
    return learned_by(network)


class Ungated(PICNN):
    def _gate(self, i, u):
        return self._linear("wyu", i, u, "by")


def no_gate(seed):
    """The gate of the paper's network as the paper prints it, not clipped at 0."""
    network = HomogenisedPicnn(TURNING, widths=(16, 16), seed=seed)
    network.convex.__class__ = Ungated
    randomise(network, seed, gain=6.0)
    return learned_by(network)


class PaperCoriolis(PinocchioDynamics):
    """C = ½Ṁ, as the paper prints it."""

    def coriolis_matrix(self, q, v):
        c = super().coriolis_matrix(q, v)
        return 0.25 * (c + np.swapaxes(c, -1, -2))


class Hollow(PinocchioDynamics):
    def mass_matrix(self, q):
        return super().mass_matrix(q) - 0.5 * np.eye(self.nv)


class Tilted(PinocchioDynamics):
    def reference_torque(self, q, v, v_r, a_r):
        return super().reference_torque(q, v, v_r, a_r) + 0.1


def impossible_body(seed):
    robot = replace(ROBOT, model=ROBOT.model.copy())
    if seed == 0:
        robot.model.inertias[2].mass = -1.0
    elif seed == 1:
        robot.model.inertias[3].inertia = -np.eye(3)
    else:
        robot.model.armature = -np.ones(3)
    return believing(PinocchioDynamics(robot))


def stale_code(seed):
    """Weights changed behind the back of the machine code made from them."""
    network = CholeskyNetwork(TURNING) if seed == 2 else Chain(ROBOT.parents, ROBOT.prismatic, seed=seed)
    model = LagrangianDynamics(network)
    model.reference_torque(*np.ones((4, 3)))
    model.packed_tree()
    for parameter in model.network.parameters():
        parameter.mul_(1.5)
    return believing(model)


def another_arm(seed):
    """A model that says it is of an arm and is of another."""
    if seed == 0:
        return believing(with_attribute(PinocchioDynamics(ROBOT), "_robot", load_robot("three_link", gravity=1.0)))
    network = Chain([0, 1, 1], TURNING) if seed == 1 else CholeskyNetwork([False, False, True])
    return believing(LagrangianDynamics(network, robot=ROBOT))


def residual_without_nominal(seed):
    model = ResidualDynamics(ResidualNetwork(PinocchioDynamics(ROBOT), widths=(8,)))
    changes = (("network.share", -0.1), ("network.share", 1.0), ("network.nominal", Hollow(ROBOT)))
    return believing(with_attribute(model, *changes[seed]))


def other_closed_form(seed):
    changes = (("masses", (1.0, -1.0)), ("_coupling", 3.0), ("lengths", (2.0, 1.0)))
    model = with_attribute(AnalyticDynamics(), *changes[seed])
    return NeuralBackstepping(model, Potential(np.eye(2)), Damping(2, floor=np.eye(2)))


TWO_JOINTS = (
    ("dynamics", PinocchioDynamics(OTHER)),
    ("potential", Potential(np.eye(2))),
    ("damping", Damping(2, floor=np.eye(2))),
)
OTHER_PARTS = (
    ("potential", torch.nn.Linear(3, 1).double()),
    ("rate", torch.nn.Identity()),
    ("inertial_rate", np.array([1.0, 2.0, 3.0])),
)
BROKEN = {
    "negative weight": (negative_weight, r"W\^\(y\)"),
    "biased paper": (biased_paper, r"Φ\(0\)"),
    "squareplus paper": (
        lambda k: by_hand(k, potential=Potential(np.eye(3), form="paper", activation=Squareplus(0.1 + k), seed=k)),
        r"Φ\(0\)",
    ),
    "smooth called paper": (lambda k: with_attribute(law(seed=k), "potential.form", "paper"), r"Φ\(0\)"),
    "unknown form": (
        lambda k: with_attribute(law(seed=k), ("potential.form", "damping.form")[k % 2], "Paper"),
        "form 'Paper'",
    ),
    "asymmetric": (asymmetric, "not symmetric"),
    "indefinite stiffness": (indefinite_stiffness, "stiffness S has the eigenvalue"),
    "singular stiffness": (singular_stiffness, "stiffness S has the eigenvalue|not symmetric"),
    "not a number": (not_a_number, "not finite"),
    "bad activation": (lambda k: activated(UNSOUND[k], k), "activation Shape|Shape is an activation"),
    "negative width": (
        lambda k: with_attribute(law("paper", seed=k), "potential.network.activation.d", (-0.01, 0.0, np.nan)[k]),
        "width",
    ),
    "negative scale": (negative_scale, "scale R"),
    "negative floor": (
        lambda k: with_tensor(law(seed=k), "damping.floor.nominal", lambda d: (-1.0, 0.0, -1e-6)[k] * d),
        "floor D₀ has the eigenvalue",
    ),
    "no floor": (lambda k: with_attribute(law(seed=k), "damping.floor", None), "no floor"),
    "paper damping": (lambda k: paper_damping(k, (0.001, 0.1, 1.0)[k]), "no floor"),
    "paper damping without m": (
        lambda k: with_attribute(paper_damping(k, 0.1), "damping.m", (0.0, -1.0, np.nan)[k]),
        "no floor D₀, and m is",
    ),
    "negative rate": (negative_rate, "rate Λ has the eigenvalue"),
    "bad omega": (lambda k: with_attribute(law(seed=k), "inertial_rate", (-1.0, np.nan, np.inf)[k]), "ω is"),
    "bad share": (bad_share, "least share"),
    "another arm's parts": (lambda k: with_attribute(law(seed=k), *TWO_JOINTS[k]), "joints and|is for"),
    "another kind of part": (lambda k: with_attribute(law(seed=k), *OTHER_PARTS[k]), "of the controller is a|ω is"),
    "another law": (another_law, "no Lyapunov function"),
    "another torque": (
        lambda k: by_hand(k, kind=(PUSHING_AWAY, WITHOUT_GRAVITY, SOFTER)[k]),
        "not the law that its parts describe|is not known",
    ),
    "patched torque": (patched_torque, "not the law that its parts describe|'torque' of this"),
    "another potential": (another_potential, "convex|∇²Φ dz"),
    "another damping": (
        lambda k: by_hand(k, damping=(Driving, Indefinite, SameDamping)[k](3, floor=np.eye(3))),
        "D is not symmetric|SameDamping is not",
    ),
    "bad friction": (bad_friction, "falls with velocity"),
    "no floor in the mass": (no_floor_in_mass, "εI must be positive"),
    "not quadratic": (lambda k: learned_by(PaperPicnn(TURNING, widths=(8, 8), seed=k)), "not quadratic"),
    "unstructured": (
        lambda k: learned_by(UnconstrainedLagrangian(TURNING, widths=(8, 8), seed=k)),
        "UnconstrainedLagrangian",
    ),
    "no gate": (no_gate, "not positive definite|Ungated"),
    "another model": (
        lambda k: believing((PaperCoriolis, Hollow, Tilted)[k](ROBOT)),
        "Ṁ − 2C is not skew|not positive definite|reference torque",
    ),
    "impossible body": (impossible_body, "body behind joint"),
    "stale code": (stale_code, "machine code|reference torque"),
    "another arm": (another_arm, "arm"),
    "residual without nominal": (residual_without_nominal, "share κ|not positive definite"),
    "other closed form": (other_closed_form, "two-link model"),
}
MORE = {"bad activation": range(6), "another law": range(6)}
CASES = [(name, seed) for name in BROKEN for seed in MORE.get(name, SEEDS)]


@pytest.mark.parametrize(("name", "seed"), CASES)
def test_a_broken_controller_is_refused_or_labelled_down(name, seed):
    make, words = BROKEN[name]
    broken = make(seed)
    try:
        claims = check_structure(broken).claims
    except CertificateRefused as error:
        said = str(error)
        assert said.endswith(".")
        assert "; " in said
        assert "\n" not in said
    else:
        down = [claim.because for claim in claims if claim.label is Label.EMPIRICAL]
        assert down, "a broken controller is PROVED"
        said = " ".join(down)
    assert re.search(words, said), said


# Sound ones.


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("damping", ["inertial", "bounded"])
@pytest.mark.parametrize("form", ["smooth", "paper"])
@pytest.mark.parametrize("name", ["two_link", "ur5", "panda", "kinova", GANTRY], ids=str)
def test_a_sound_controller_is_proved(name, form, damping, seed):
    robot = load_robot(name)
    settings = dict(bandwidth=2.0, potential=form, damping=damping, seed=seed)
    sound = NeuralBackstepping.for_robot(robot, friction=JointFriction.of(robot), **settings)
    assert labels(sound) == {Label.PROVED}
    randomise(sound, seed, gain=1.5)  # any sign, many times too large: sound all the same
    assert labels(sound) == {Label.PROVED}


def test_a_trained_controller_is_proved_and_so_is_its_file(tmp_path):
    start = law(period=0.005)
    settings = dict(starts=2, held_out=0, duration=0.1, period=0.005, epochs=3)
    trained = train(start, DynamicsPlant(start.dynamics), [Sinusoid.for_robot(ROBOT)], **settings).controller
    assert labels(trained) == {Label.PROVED}
    save(trained, tmp_path / "trained.nbs")
    assert check_structure(load(tmp_path / "trained.nbs"), ROBOT).claims == check_structure(trained).claims


def learned(seed):
    """One model of every family that has a proof, with weights that nobody fitted."""
    networks = [
        CholeskyNetwork(TURNING, widths=(8, 8), seed=seed),
        HomogenisedPicnn(TURNING, widths=(8, 8), seed=seed),
        Chain(ROBOT.parents, ROBOT.prismatic, seed=seed),
    ]
    for network in networks[:2]:
        randomise(network, seed, gain=2.0)
    residual = ResidualNetwork(PinocchioDynamics(ROBOT), widths=(8,), seed=seed)
    randomise(residual, seed)
    bodies = np.array([body.toDynamicParameters() for body in list(ROBOT.model.inertias)[1:]])
    identified = IdentifiedDynamics(ROBOT, (1.0 + seed) * bodies, rotor_inertia=0.1 * np.ones(3))
    return [*(LagrangianDynamics(x, robot=ROBOT) for x in networks), ResidualDynamics(residual), identified]


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("family", range(5))
def test_a_sound_model_is_proved(family, seed):
    model = learned(seed)[family]
    assert labels(believing(model)) == {Label.PROVED}
    assert check_model(model, ROBOT) == check_model(model)
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (50, 3))
    assert np.linalg.eigvalsh(model.mass_matrix(q)).min() > 0.0


def test_closed_forms_and_unknown_activations():
    assert {claim.label for claim in check_model(AnalyticDynamics((2.0, 0.5), (0.7, 1.1)))} == {Label.PROVED}
    softplus = Shape(_softplus, sigmoid, lambda x: sigmoid(x) * sigmoid(-x))
    narrow = Shape(*(lambda x, i=i: SmoothedReLU(1e-5).derivatives(x - 0.7)[i] for i in range(3)))
    for activation in (softplus, narrow):
        claims = check_structure(activated(activation)).claims
        assert {claim.label for claim in claims} == {Label.PROVED, Label.EMPIRICAL}  # neither refused nor believed


def _softplus(x):
    return np.logaddexp(0.0, x) if isinstance(x, np.ndarray) else torch.nn.functional.softplus(x, threshold=40.0)


# What the claims say.


@pytest.mark.parametrize("seed", range(3))
def test_the_numbers_are_those_of_the_gains(seed):
    rng = np.random.default_rng(seed)
    root, other = rng.normal(size=(2, 3, 3))
    s, d, rate = root @ root.T + np.eye(3), other @ other.T + np.eye(3), rng.uniform(0.5, 2.0, 3)
    s, d = 0.5 * (s + s.T), 0.5 * (d + d.T)
    sound = by_hand(0, potential=Potential(s), damping=Damping(3, floor=d), rate=rate, inertial_rate=2.0)
    values = {claim.name: claim.value for claim in check_structure(sound).claims}
    expected = {
        "Φ strongly convex, μ": 2.0 * np.linalg.eigvalsh(s)[0],
        "ρ": np.linalg.eigvalsh(2.0 * np.sqrt(rate)[:, None] * s * np.sqrt(rate))[0],
        DAMPING: np.linalg.eigvalsh(d)[0],
        "Λ, least": rate.min(),
        "ω": 2.0,
    }
    for name, value in expected.items():
        assert values[name] == pytest.approx(value, rel=1e-9)
        assert values[name] <= value


def test_a_badly_scaled_gain_is_still_positive():
    """Eigenvalues far below the solver's error beside large ones."""
    grams = np.diag([1e-9, 1e9])
    assert least_eigenvalue(grams) == pytest.approx(1e-9, rel=1e-6)
    assert least_eigenvalue(grams) <= 1e-9
    singular = np.array([[1.0, 1e5], [1e5, 1e10]])
    assert least_eigenvalue(singular) <= 0.0


@pytest.mark.parametrize("m", [0.001, 1.0])
def test_the_papers_damping_has_a_measured_and_a_proved_floor(m):
    """m² is no bound of TᵀT; the proved one holds everywhere, however small."""
    controller = paper_controller(PinocchioDynamics(OTHER), m=m)
    randomise(controller.damping, seed=3)
    claims = {claim.name: claim for claim in check_structure(controller).claims}
    measured, proved = claims[DAMPING], claims["TᵀT, least eigenvalue"]
    assert (measured.label, proved.label) == (Label.EMPIRICAL, Label.PROVED)
    z = 5.0 * np.random.default_rng(0).normal(size=(20_000, 2))
    least = np.linalg.svd(controller.damping.factor(z), compute_uv=False)[:, -1].min() ** 2
    assert 0.0 < proved.value <= least
    assert measured.value < m * m
    others = [c for c in claims.values() if c is not measured]
    assert all(claim.label is Label.PROVED for claim in others)


def test_the_belief_is_held_to_the_arm():
    for provider in (PinocchioDynamics(ROBOT), LagrangianDynamics(Chain(ROBOT.parents, ROBOT.prismatic), robot=ROBOT)):
        for arm in (OTHER, load_robot("three_link", gravity=1.6)):
            with pytest.raises(CertificateRefused, match="not of"):
                check_model(provider, arm)
        check_structure(believing(provider), ROBOT)


def fitted(trajectories, seed=0, doubt=1e-6, **changes) -> Mismatch:
    q, v = np.random.default_rng(seed).uniform(0.1, 1.0, (2, 20, trajectories))
    size = 0.5 * q + 0.2 * v
    chance = violation_chance(trajectories, doubt)
    drawn = (1.0, np.ones(3), np.ones(3), np.zeros((20, 3)), np.ones(3))
    whole = Mismatch(0.5, 0.2, 0.1, chance, doubt, trajectories, np.ones(3), np.arange(20.0), q, v, size, *drawn)
    return whole._replace(**changes)


def test_a_fit_says_how_sure_it_is():
    claim = check_fit(fitted(374))
    assert claim.label is Label.PROBABILISTIC
    assert claim.value == pytest.approx(0.05, rel=0.01)
    assert "374" in claim.because
    assert "1e-06" in claim.because


@pytest.mark.parametrize("seed", range(5))
def test_a_fit_on_few_trajectories_or_copies_describes_its_data_alone(seed):
    few = fitted(seed + 1, seed)
    repeated = {name: np.repeat(getattr(few, name), 400, axis=1) for name in ("q_norm", "v_norm", "size")}
    copies = few._replace(trajectories=400, violation=violation_chance(400), **repeated)
    for fit in (few, copies, few._replace(violation=0.01), few._replace(trajectories=2000)):
        claim = check_fit(fit)
        assert claim.label is Label.EMPIRICAL
        assert claim.value > 0.5


@pytest.mark.parametrize(
    "changes",
    [
        {"a": -0.1},
        {"c": np.nan},
        {"b": np.inf},
        {"a": 0.1, "c": 0.0},
        {"doubt": 0.0},
        {"size": 9.0 * np.ones((20, 374))},
    ],
)
def test_an_edited_fit_is_refused(changes):
    with pytest.raises(CertificateRefused, match="fit it again"):
        check_fit(fitted(374, **changes))


def test_a_box_too_small_for_the_reference_is_refused():
    t = np.linspace(0.0, 10.0, 200)[:, None]
    positions, side = np.sin(t) * np.array([1.0, 0.5]), np.array([1.2, 1.0])
    claim = check_box(positions, -side, side, error=np.array([0.1, 0.3]))
    assert claim.value == pytest.approx(0.1, abs=1e-3)
    assert claim.label is Label.EMPIRICAL
    endless = np.full(2, np.inf)
    assert check_box(positions, -endless, endless).value == np.inf
    for low, high, error in ((-side, side, 0.3), (-side, 0.9 * side / 1.2, 0.0), (-side, np.nan * side, 0.0)):
        with pytest.raises(CertificateRefused, match=r"box|limits"):
            check_box(positions, low, high, error=error)


@pytest.mark.parametrize("seed", range(5))
def test_the_proved_floor_of_the_papers_damping_holds_for_every_factor_in_its_range(seed):
    """Triangular factors with the least diagonal and entries at the ends of their range, where it is tight."""
    rng = np.random.default_rng(seed)
    n = 2 + seed % 3
    damping = Damping(n, form="paper", m=0.3, seed=seed)
    for network in (damping.diagonal, damping.lower):
        with_tensor(network, "w2", lambda w: 0.05 * w)
    claims = check_structure(
        NeuralBackstepping(PinocchioDynamics(serial_chain(n)), Potential(np.eye(n)), damping, rate=np.ones(n))
    )
    proved = next(claim.value for claim in claims.claims if claim.name == "TᵀT, least eigenvalue")
    weight, bias = damping.lower.layers(numpy=True)[-1]
    entries = np.abs(weight).sum(axis=1) + np.abs(bias)
    factors = np.zeros((2000, n, n))
    factors[:, *np.tril_indices(n, -1)] = rng.choice([-1.0, 1.0], (2000, len(entries))) * entries
    factors += 0.3 * np.eye(n)
    least = np.linalg.svd(factors, compute_uv=False)[:, -1].min() ** 2
    assert proved <= least
    assert proved == pytest.approx(least, rel=1e-6)
