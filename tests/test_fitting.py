"""Fitting models to data: the mathematics of the residuals, the optimisers, what is reported and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

import nbs_pin as nbs
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.registry import NETWORKS, make_network
from nbs_pin.dynamics.residual import ResidualNetwork
from nbs_pin.identification import network_fit
from nbs_pin.identification.collect import collect
from nbs_pin.identification.compatibility import arm_fault
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.fit import fit, split_data
from nbs_pin.identification.fit_report import torque_errors, torque_nmse
from nbs_pin.identification.network_equations import Equation, Equations
from nbs_pin.identification.network_fit import fit_network
from nbs_pin.identification.unidentifiable import unidentifiable
from nbs_pin.robots.catalogue import find

ROBOT = nbs.load_robot("two_link")
TRUTH = nbs.PinocchioDynamics(ROBOT)
FRICTION = JointFriction(np.array([0.7, 0.3]), np.array([0.9, 0.4]), 0.1)


def states(samples, seed=0, noise=0.0, friction=None, still=False):
    """Independent states of the two-link arm and their torque."""
    rng, n = np.random.default_rng(seed), ROBOT.nv
    q = rng.uniform(-np.pi, np.pi, (samples, n))
    v, a = ((0.0 if still else scale) * rng.normal(size=(samples, n)) for scale in (1.5, 4.0))
    tau = nbs.inverse_dynamics(TRUTH, q, v, a) + noise * rng.normal(size=(samples, n))
    tau += 0.0 if friction is None else friction.torque(v)
    order = np.arange(samples)
    return Dataset(q, v, a, tau, 1.0 * order, order, ROBOT.parents, ROBOT.prismatic, ROBOT.name)


def relative(model):
    """Relative errors of M, C v and G over fresh states."""
    fresh = states(300, seed=99)
    q, v = fresh.q, fresh.v
    pairs = [(m.mass_matrix(q), (m.coriolis_matrix(q, v) @ v[..., None]), m.gravity(q)) for m in (model, TRUTH)]
    return [np.linalg.norm(x - y) / np.linalg.norm(y) for x, y in zip(*pairs, strict=True)]


def equations(name, loss="torque", friction=None):
    """Of a small network with parameters away from their first ones."""
    if name == "residual":
        network = ResidualNetwork(TRUTH, widths=(4,))
    else:
        network = make_network(name, [False, True], 1, widths=(4, 4), epsilon=0.5)
    equation = Equation.fitted(network, friction, loss)
    with torch.no_grad():
        for p in equation.parameters():
            p.add_(0.1 * torch.randn(p.shape, dtype=p.dtype, generator=torch.Generator().manual_seed(p.numel())))
    return Equations.of(equation, states(6))


@pytest.mark.parametrize("friction", [None, FRICTION], ids=["frictionless", "friction"])
@pytest.mark.parametrize(
    ("name", "loss"),
    [*((name, "torque") for name in (*NETWORKS, "residual")), ("cholesky", "acceleration"), ("picnn", "acceleration")],
)
def test_the_jacobian_is_that_of_finite_differences(name, loss, friction):
    system = equations(name, loss, friction)
    theta, rows = system.theta, torch.arange(6)
    J = system.jacobian(theta, rows)
    direction = torch.randn(len(theta), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    moved = [system.residual(theta + h * direction, rows).reshape(-1) for h in (1e-6, -1e-6)]
    assert_allclose(J @ direction, (moved[0] - moved[1]) / 2e-6, rtol=1e-6, atol=1e-6 * float(J.abs().max()))


def test_the_normal_equations_are_sums_over_blocks(monkeypatch):
    system = equations("cholesky", friction=FRICTION)
    theta, rows = system.theta, torch.tensor([0, 2, 3, 5])
    monkeypatch.setattr("nbs_pin.identification.network_equations._LARGEST_BLOCK", 3 * 2 * len(theta))
    matrix, slope = system.normal(theta, rows)
    J, r = system.jacobian(theta, rows), system.residual(theta, rows).reshape(-1)
    assert_allclose(matrix, J.T @ J / 8, atol=1e-12)
    assert_allclose(slope, J.T @ r / 8, atol=1e-12)
    assert system.cost(theta, rows) == pytest.approx(float(r.square().mean()))


def test_writing_parameters_changes_the_network():
    system = equations("cholesky", friction=FRICTION)
    theta = system.theta + 0.01
    system.write(theta)
    assert_array_equal(system.theta, theta)
    data, network = states(6), system.equation.network
    q, v, a = (torch.from_numpy(x) for x in (data.q, data.v, data.a))
    friction = system.equation.friction()
    expected = network.torque(q, v, v, a).detach().numpy() + friction.torque(data.v) - data.tau
    assert_allclose(system.residual(theta).detach() * system.unit, expected, atol=1e-10)


@pytest.fixture(scope="module")
def cholesky():
    """A network fitted to 800 states."""
    return fit(states(800), "cholesky", robot=ROBOT, widths=(12, 12))


def test_levenberg_marquardt_finds_the_arm(cholesky):
    mass, coriolis, gravity = relative(cholesky)
    assert max(mass, gravity) < 0.02
    assert coriolis < 0.06
    assert cholesky.report.test_nmse < 1e-3


def test_the_report_says_what_was_done(cholesky):
    report, (train, test) = cholesky.report, split_data(states(800))
    assert (report.model, report.seed, report.samples) == ("cholesky", 0, 640)
    assert report.parameters == sum(p.numel() for p in cholesky.network.parameters())
    assert report.train_nmse == pytest.approx(torque_nmse(cholesky, train))
    assert report.test_nmse == pytest.approx(torque_nmse(cholesky, test))
    assert len(report.history) == len(report.held_out) <= network_fit.ITERATIONS["lm"] + 1
    assert report.history[0] > 100.0 * report.history[-1]
    assert report.seconds > 0.0
    assert report.evaluations > len(report.history)
    assert report.unidentifiable == ()
    assert cholesky.robot is ROBOT
    assert cholesky.friction is None


def test_the_same_seed_gives_the_same_model_and_another_seed_another():
    data, q = states(150), states(5, seed=3).q
    mass = [fit(data, "cholesky", seed, widths=(5,), iterations=3).mass_matrix(q) for seed in (0, 0, 1)]
    assert_array_equal(mass[0], mass[1])
    assert np.abs(mass[0] - mass[2]).max() > 1e-3


def test_what_is_held_out_chooses_the_iteration():
    data = states(120, noise=8.0)
    model = fit(data, "cholesky", widths=(16, 16), friction=False, offset=False)
    report = model.report
    train, test = split_data(data)
    unit = train.tau.std(axis=0)
    assert np.mean((torque_errors(model, test) / unit) ** 2) == pytest.approx(min(report.held_out), rel=1e-9)
    assert int(np.argmin(report.held_out)) < len(report.held_out) - 1
    assert report.history[-1] < report.history[int(np.argmin(report.held_out))]


@pytest.mark.parametrize("optimiser", ["adam", "lbfgs"])
def test_first_order_optimisers_lower_the_cost(optimiser):
    report = fit(states(100), "cholesky", widths=(8, 8), optimiser=optimiser, iterations=25).report
    assert report.history[-1] < 0.5 * report.history[0]
    assert len(report.history) <= 26


@pytest.mark.parametrize("name", NETWORKS)
def test_every_family_learns(name):
    report = fit(states(30), name, widths=(4,), iterations=5, held_out=0.0).report
    assert report.history[-1] < 0.5 * report.history[0]


def test_the_acceleration_is_learned_too():
    report = fit(states(100), "cholesky", widths=(8,), loss="acceleration", iterations=8, epsilon=0.1).report
    assert report.history[-1] < 0.3 * report.history[0]


def test_friction_is_learned_beside_a_nearly_known_arm():
    data = states(300, noise=1e-3, friction=FRICTION)
    model = fit(data, "residual", robot=ROBOT, friction=True, widths=(4,), transition=0.1)
    assert_allclose(model.friction.viscous, FRICTION.viscous, rtol=0.02)
    assert_allclose(model.friction.coulomb, FRICTION.coulomb, rtol=0.02)
    assert max(relative(model)) < 1e-3
    without = fit(data, "residual", robot=ROBOT, widths=(4,), friction=False)
    assert without.report.test_nmse > 100.0 * model.report.test_nmse


def test_what_a_nominal_arm_has_wrong_is_learned(guess):
    model = fit(states(200), "residual", robot=guess, widths=(8,), iterations=12)
    assert (np.array(relative(model)) < 0.2 * np.array(relative(nbs.PinocchioDynamics(guess)))).all()


def test_identified_models_come_through_the_same_door():
    model = fit(states(100, friction=FRICTION), "identified", robot=ROBOT, friction=True, transition=0.1)
    assert max(relative(model)) < 1e-8
    assert_allclose(model.friction.viscous, FRICTION.viscous, rtol=1e-6)
    assert model.report.test_nmse < 1e-16
    assert len(model.report.details["noise_Nm"]) == 2
    assert model.report.history == ()


def test_ctrl_c_keeps_the_best(monkeypatch):
    calls, normal = [], Equations.normal

    def interrupted(self, theta, rows):
        calls.append(theta)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return normal(self, theta, rows)

    monkeypatch.setattr(Equations, "normal", interrupted)
    data = states(200)
    found = fit_network(lambda seed: make_network("cholesky", [False] * 2, seed, widths=(6,)), data)
    assert found.stopped == "interrupted"
    assert len(found.history) == 4
    system = Equations.of(Equation.fitted(found.network, None, "torque"), data)
    assert system.cost(system.theta) == pytest.approx(min(found.history))


def test_a_start_that_leads_nowhere_is_replaced(monkeypatch):
    monkeypatch.setattr(network_fit, "_COARSE_STEPS", 12)
    begun = []

    def make(seed):
        begun.append(seed)
        network = make_network("cholesky", [False] * 2, seed, widths=(6, 6))
        if len(begun) == 1:
            with torch.no_grad():
                for p in network.parameters():
                    p.zero_()  # a saddle: every neuron is the same for ever
        return network

    found = fit_network(make, states(200))
    assert begun[0] == 0
    assert len(begun) == 2
    assert found.history[-1] < 0.05


def test_data_at_rest_leave_the_inertia_open_and_data_of_few_poses_the_rest():
    still = states(400, still=True)
    network = fit(still, "cholesky", widths=(8, 8), iterations=20, friction=False, offset=False).network
    told = unidentifiable(network, still, names=ROBOT.joint_names)
    assert {line.split(":")[0] for line in told} == {f"inertia of {joint}" for joint in ROBOT.joint_names}
    moving = states(400)
    assert unidentifiable(network, moving) == ()
    assert unidentifiable(network, moving.take(np.cos(moving.q[:, 1]) < -0.9))


def test_data_without_torque_leave_the_scale_open():
    data = states(100)
    zero = 0.0 * data.q
    free = replace(data, a=nbs.forward_dynamics(TRUTH, data.q, data.v, zero), tau=zero)
    model = fit(free, "cholesky", widths=(6,), loss="acceleration", iterations=4, epsilon=0.1)
    assert model.report.unidentifiable[0].startswith("the torque's scale")
    assert np.isnan(model.report.train_nmse)
    for name, robot in (("cholesky", None), ("identified", ROBOT)):
        with pytest.raises(ArgumentError, match=r"no torque"):
            fit(free, name, robot=robot)


def test_nmse_is_the_mean_over_joints_whose_torque_varies():
    data = states(50)
    errors = torque_errors(TRUTH, replace(data, tau=data.tau + 1.0))
    assert_allclose(errors, -1.0, atol=1e-9)
    assert torque_nmse(TRUTH, replace(data, tau=data.tau + 1.0)) == pytest.approx(np.mean(1.0 / data.tau.var(axis=0)))
    flat = data.tau.copy()
    flat[:, 1] = 3.0
    squares = np.square(torque_errors(TRUTH, replace(data, tau=flat))).mean(axis=0)
    assert torque_nmse(TRUTH, replace(data, tau=flat)) == pytest.approx(squares[0] / flat[:, 0].var(), abs=1e-12)


def test_whole_trajectories_are_held_out():
    data = replace(states(40), trajectory=np.repeat(np.arange(4), 10))
    train, test = split_data(data, 0.25)
    assert set(train.trajectory).isdisjoint(test.trajectory)
    assert (len(train), len(test)) == (30, 10)
    assert split_data(data, 0.0) == (data, None)
    one = data.take(data.trajectory == 0)
    assert split_data(one) == (one, None)
    assert split_data(data, one) == (data, one)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"model": "wavelets"}, r"'wavelets' is unknown; choose one of .*cholesky"),
        ({"model": "identified"}, "needs the arm's URDF; give robot="),
        ({"model": "residual"}, "needs the arm's URDF; give robot="),
        ({"robot": nbs.load_robot("three_link")}, r"2 joints and three_link 3"),
        ({"held_out": 1.5}, r"held_out is 1\.5"),
        ({"width": 3}, r"takes no width=3; it takes loss, optimiser"),
        ({"loss": "energy"}, r"loss 'energy' is unknown"),
        ({"optimiser": "newton"}, r"optimiser 'newton' is unknown"),
        ({"iterations": 0}, r"iterations is 0"),
        ({"model": "identified", "robot": ROBOT, "optimiser": "lm"}, r"takes no optimiser='lm'"),
        ({"model": "residual", "robot": ROBOT, "loss": "acceleration"}, r"takes no loss="),
        ({"held_out": collect(nbs.load_robot("three_link"), "uniform", 5)}, "held_out has 3 joints and the data 2"),
    ],
)
def test_what_cannot_be_meant_is_refused(settings, words):
    with pytest.raises(ArgumentError, match=words):
        fit(states(20), **({"model": "cholesky"} | settings))


def rows(robot=ROBOT, samples=30, seed=0):
    """Data that say which arm they are of."""
    return collect(robot, "uniform", samples, seed)


def test_data_of_another_arm_are_refused():
    """Two arms of seven turning joints in a row: only their names and fingerprints tell them apart."""
    panda, xarm = nbs.load_robot("panda"), nbs.load_robot("xarm7")
    data = rows(panda)
    for model in ("chain", "identified", "residual"):
        with pytest.raises(ArgumentError, match="the data are of panda, not of xarm7"):
            fit(data, model, robot=xarm)
    with pytest.raises(ArgumentError, match="held_out is of xarm7 and the data of panda"):
        fit(data, "identified", robot=panda, held_out=rows(xarm))
    with pytest.raises(ArgumentError, match="held_out is of xarm7"):
        split_data(data, rows(xarm))


@pytest.mark.parametrize("change", [{"parents": np.array([0, 0])}, {"prismatic": np.array([True, False])}])
def test_data_of_another_tree_are_refused(change):
    data, other = states(20), replace(states(20), **change)
    with pytest.raises(ArgumentError, match=r"those of two_link revolute on the base, revolute on joint 1; give"):
        fit(other, "identified", robot=ROBOT)
    with pytest.raises(ArgumentError, match="the joints of held_out are"):
        fit(data, "identified", robot=ROBOT, held_out=other)


@pytest.fixture(scope="module")
def guess(tmp_path_factory):
    """Another description of the same joints, with heavier links."""
    text = find("two_link").path.read_text().replace('mass value="1"', 'mass value="1.5"')
    path = tmp_path_factory.mktemp("urdf") / "guess.urdf"
    path.write_text(text.replace('name="two_link"', 'name="guess"'))
    return nbs.load_robot(path)


def test_a_nominal_arm_may_be_wrong(guess):
    """What "identified" and "residual" are for: another description of the same joints, other limits, other gravity."""
    data = rows()
    assert (guess.name, guess.sha256 == ROBOT.sha256) == ("guess", False)
    assert fit(data, "identified", robot=guess).report.train_nmse < 1e-5
    assert fit(rows(guess), "identified", robot=ROBOT).report.train_nmse < 1e-5
    for robot in (guess, nbs.load_robot("two_link", gravity=9.0), ROBOT.with_effort_limit(3.0)):
        assert arm_fault(data, robot) == ""
    assert split_data(data, rows(ROBOT.with_effort_limit(30.0), seed=1))[1] is not None
    assert arm_fault(states(5), ROBOT) == arm_fault(replace(states(5), robot="mine"), ROBOT) == ""


@pytest.mark.parametrize("model", ["cholesky", "chain"])
def test_single_precision_is_learned_from(model):
    data = states(60)
    half = {name: getattr(data, name).astype(np.float32) for name in ("q", "v", "a", "tau", "t")}
    settings = {"iterations": 2, "widths": (4,)} if model == "cholesky" else {}
    assert np.isfinite(fit(replace(data, **half), model, **settings).report.train_nmse)
