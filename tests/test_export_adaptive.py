"""Laws that adapt in C: torques, estimates and the load beside Python, along closed loops and at the limits."""

import ctypes
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.controllers.unknowns import ADAPTS
from nbs_pin.robots.places import tool_frame
from tests.commands import refusal
from tests.imitations import FRANKA, ROS, ROS_DRIVER
from tests.test_adaptive import OTHERS, stirred

sys.path.insert(0, str(Path(__file__).parent.parent / "tools"))
import export_check

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler here")
GANTRY = str(Path(__file__).parent / "data" / "gantry.urdf")
PERIOD, STEPS = 0.001, 1500


class InC:
    """An exported law, called from Python, with the state of one arm."""

    def __init__(self, header):
        text, library = header.read_text(), header.with_suffix(".so")
        flags = [*export_check.STRICT, "-O2", "-shared", "-fPIC"]
        subprocess.run(["gcc", *flags, header.with_suffix(".c"), "-lm", "-o", library], check=True)
        self.name, self.library = header.stem, ctypes.CDLL(str(library))
        self.real = ctypes.c_float if "typedef float" in text else ctypes.c_double
        duals, self.n = (int(re.search(rf"{word}(\d+)", text)[1]) for word in (r" dual\[", r"_JOINTS "))
        vector = self.real * self.n
        names = [("tau", vector), ("dual", self.real * duals), ("output", vector), ("before", vector)]
        self.state = type("State", (ctypes.Structure,), {"_fields_": names})()
        self.start(np.zeros(self.n))

    def __call__(self, what, *given):
        arrays = [(self.real * len(x))(*x) if np.ndim(x) else self.real(x) for x in given]
        function = getattr(self.library, f"{self.name}_{what}")
        function.restype = self.real if what == "load" else ctypes.c_int
        return function(ctypes.byref(self.state), *arrays), np.array(arrays[-1])

    def start(self, tau):
        self("start", tau)

    def torque(self, q, v, aim, period=PERIOD):
        return self("torque", q, v, *aim, period, np.zeros(self.n))[1]

    def step(self, q, v, aim, period=PERIOD):
        return self("step", q, v, *aim, period, np.zeros(self.n))

    def remember(self, memory):
        """The memory of Python as the state."""
        for mine, own in (("dual", memory.duals), ("output", memory.output), ("before", memory.before)):
            getattr(self.state, mine)[:] = own

    def load(self):
        return self("load", np.zeros(3))

    @property
    def duals(self):
        return np.array(self.state.dual)


def exported(law, folder, **options):
    """A law in C that has passed its self-test with every warning an error."""
    header = law.export(folder, **options)
    export_check.self_test(folder, "gcc", ["-O1"])
    export_check.symbols(folder)
    return InC(header)


def share(found, tau, least=0.0):
    """The largest deviation as a share of the torque's size."""
    return float(np.abs(found - tau).max() / max(np.abs(tau).max(), least))


def ridden(law, in_c, plant, reference, start, *, single=False):
    """The C law drives the plant, Python's runs beside it: largest deviation, steps with torques cut off, last memory.

    Each has its own memory; `single`: C has that of Python before every step, and both the state and the reference that
    fit into a float, as rounding of positions alone changes the torque of kinova by 1.4e-4 of its size.
    """
    q, v, limit, law = start, np.zeros(law.nv), law.robot.effort_limit, law.compile()
    memory, cut, worst = law.initial_memory(q), 0, 0.0
    for k in range(STEPS):
        aim = reference(k * PERIOD)
        if single:
            in_c.remember(memory)
            q, v, *aim = (np.asarray(x, np.float32).astype(float) for x in (q, v, *aim))
            aim = Reference(*aim)
        found = in_c.torque(q, v, aim)
        tau, memory = law.step(memory, q, v, aim, PERIOD)
        worst = max(worst, share(found, tau))
        cut += bool((np.abs(tau) > limit).any())
        q, v = plant.step(q, v, np.clip(found, -limit, limit), PERIOD)
    return worst, cut, memory


@pytest.mark.parametrize(
    ("arm", "adapts", "payload"),
    [
        ("panda", ["load", "friction", "rotors"], 2.0),
        ("panda", ["links"], 2.0),
        ("kinova", ["load", "friction", "rotors"], 2.0),
        (GANTRY, list(ADAPTS), 2.0),
        ("two_link", list(ADAPTS), 0.5),
    ],
    ids=["panda", "panda-links", "kinova", "gantry", "two_link"],
)
def test_a_closed_loop_in_c_is_the_one_in_python(arm, adapts, payload, tmp_path):
    """1.5 s with a load that nobody told, from an error that drives torques beyond their limits."""
    robot = nbs.load_robot(arm)
    settings = {"load_mass": 4.0} if "load" in adapts else {}
    law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(robot), adapts, **settings)
    in_c = exported(law, tmp_path / "law")
    plant = nbs.DynamicsPlant.for_robot(robot.with_payload(tool_frame(robot), payload, com=[0.02, 0.0, 0.03]))
    reference = nbs.Sinusoid.for_robot(robot)
    start = reference(0.0).q + 0.3
    worst, cut, memory = ridden(law, in_c, plant, reference, start)
    assert worst <= 1e-12
    assert 0 < cut < STEPS // 2
    first = law.initial_memory(start).duals
    assert np.abs(memory.duals - first).max() > 0.5
    np.testing.assert_allclose(in_c.duals, memory.duals, rtol=0.0, atol=1e-10)
    if "load" in adapts:
        mass, centre = in_c.load()
        believed = law.estimate(memory)
        assert believed.load_mass > 0.2
        np.testing.assert_allclose(mass, believed.load_mass, rtol=1e-10)
        np.testing.assert_allclose(centre, believed.load_centre, atol=1e-10)


@pytest.mark.parametrize("arm", ["panda", "kinova", GANTRY], ids=["panda", "kinova", "gantry"])
def test_in_float_every_step_is_the_one_from_the_same_memory(arm, tmp_path):
    robot = nbs.load_robot(arm)
    law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(robot), ADAPTS, load_mass=4.0)
    in_c = exported(law, tmp_path / "law", precision="float")
    plant = nbs.DynamicsPlant.for_robot(robot.with_payload(tool_frame(robot), 2.0))
    reference = nbs.Sinusoid.for_robot(robot)
    worst, cut, _ = ridden(law, in_c, plant, reference, reference(0.0).q + 0.3, single=True)
    assert worst <= 1e-4
    assert 0 < cut < STEPS // 2


@pytest.mark.parametrize("arm", ["two_link", GANTRY], ids=["two_link", "gantry"])
@pytest.mark.parametrize("name", OTHERS)
def test_integral_action_is_the_same_in_c(name, arm, tmp_path):
    robot = nbs.load_robot(arm)
    law = nbs.AdaptiveLaw(OTHERS[name](robot), ["offsets"])
    in_c = exported(law, tmp_path / "law")
    assert not hasattr(in_c.library, "law_law_load")
    plant = nbs.DynamicsPlant.for_robot(robot.with_payload(tool_frame(robot), 1.0))
    reference = nbs.Sinusoid.for_robot(robot)
    worst, _, memory = ridden(law, in_c, plant, reference, reference(0.0).q + 0.02)
    assert worst <= 1e-12
    assert np.abs(memory.duals).max() > 1e-2
    np.testing.assert_allclose(in_c.duals, memory.duals, rtol=0.0, atol=1e-10)


@pytest.fixture(scope="module")
def two_link(tmp_path_factory):
    """A law that adapts all there is, with friction fed forward and a leak, and its C."""
    robot = nbs.load_robot("two_link")
    friction = nbs.JointFriction([0.3, 0.1], [0.5, 0.2])
    law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(robot, friction=friction), ADAPTS, leak=0.7)
    return law, exported(law, tmp_path_factory.mktemp("all") / "law", rate_limit=500.0)


def states(n, size, count=50):
    for each in size * np.random.default_rng(6).normal(size=(count, 5, n)):
        q, v, *aim = each
        yield q, v, Reference(*aim)


def test_one_step_from_any_memory_moves_the_estimates_as_python_does(two_link):
    law, in_c = two_link
    moved = []
    for seed, (q, v, aim) in enumerate([*states(law.nv, 0.01), *states(law.nv, 2.0)]):
        memory = stirred(law, (), seed)
        memory = memory._replace(duals=8.0 * memory.duals)  # some beyond the cut
        in_c.remember(memory)
        found, (tau, after) = in_c.torque(q, v, aim), law.step(memory, q, v, aim, PERIOD)
        assert share(found, tau) <= 1e-12
        for name, expected in (("dual", after.duals), ("output", after.output), ("before", after.before)):
            own = np.array(getattr(in_c.state, name))
            np.testing.assert_allclose(own, expected, rtol=0.0, atol=1e-12 * np.abs(expected).max())
        moved.append(bool((np.abs(tau) <= law.robot.effort_limit).all()))
    assert 0.1 < np.mean(moved) < 0.9


def test_estimates_wait_where_python_lets_them_wait(two_link):
    law, in_c = two_link
    q, v, aim = next(states(law.nv, 0.01))
    for before, limit in (([np.nan, 0.1], 1.0), ([0.1, np.inf], 1.0), ([0.1, 0.1], 5.0 * law.robot.effort_limit[0])):
        memory = law.initial_memory(q)._replace(before=np.array(before))
        in_c.start(np.zeros(2))
        in_c.remember(memory)
        far = aim._replace(q=aim.q + (10.0 if limit > 1.0 else 0.0))
        in_c.torque(q, v, far)
        _, after = law.step(memory, q, v, far, PERIOD)
        np.testing.assert_allclose(in_c.duals, memory.duals, rtol=0.0, atol=1e-13)
        np.testing.assert_allclose(after.duals, memory.duals, rtol=0.0, atol=1e-13)


def test_a_refused_step_changes_nothing(two_link):
    law, in_c = two_link
    q, v, aim = next(states(law.nv, 0.01))
    in_c.start(np.array([1.0, 500.0]))
    assert list(in_c.state.tau) == [1.0, law.robot.effort_limit[1]]
    np.testing.assert_array_equal(in_c.duals, law.unknowns.start)
    in_c.step(q, v, aim)
    held = bytes(in_c.state)
    for given, period in ((np.array([np.nan, 0.0]), PERIOD), (q, 0.00101), (q, -PERIOD), (q, np.nan)):
        status, tau = in_c.step(given, v, aim, period)
        assert status == 1
        assert bytes(in_c.state) == held
        np.testing.assert_array_equal(tau, np.array(in_c.state.tau))
    in_c.state.dual[0] = np.nan
    held = bytes(in_c.state)
    status, _ = in_c.step(q, v, aim)
    assert status == 2
    assert bytes(in_c.state) == held


def test_without_gravity_the_weight_of_the_first_model_alone_is_left_out(tmp_path):
    """An arm that holds its own weight does not know the load that the law has learned."""
    robot = nbs.load_robot("panda")
    law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(robot), ["load", "friction", "rotors"], load_mass=4.0)
    in_c, weightless = exported(law, tmp_path / "law"), exported(law, tmp_path / "weightless", gravity=False)
    memory = stirred(law, ())
    for q, v, aim in states(law.nv, 0.05, 20):
        for each in (in_c, weightless):
            each.remember(memory)
        whole, rest = in_c.torque(q, v, aim), weightless.torque(q, v, aim)
        np.testing.assert_allclose(
            rest, whole - law.law.dynamics.gravity(q), rtol=0.0, atol=1e-12 * np.abs(whole).max()
        )
        np.testing.assert_array_equal(weightless.duals, in_c.duals)


def test_a_compiled_law_has_the_same_c(two_link, tmp_path):
    law, _ = two_link
    first, second = law.export(tmp_path / "one" / "law"), law.compile().export(tmp_path / "two" / "law")
    for name in (first.name, first.with_suffix(".c").name):
        assert (first.parent / name).read_text() == (second.parent / name).read_text()


def test_the_self_test_notices_estimates_that_move_otherwise(two_link, tmp_path):
    law, _ = two_link
    path = law.export(tmp_path / "law").with_suffix(".c")
    text = path.read_text()
    for right, wrong in (
        ("moves ? moved[i] : kept[i]", "kept[i]"),
        ("moves = moves && ", "moves = moves || "),
        ("state->before[i] = state->output[i];", "state->before[i] = output[i];"),
        ("1 / (1 + exp(-values[k]))", "1 / (1 + exp(values[k]))"),
        ("if (cut) {", "if (0) {"),
    ):
        assert right in text
        path.write_text(text.replace(right, wrong))
        with pytest.raises(export_check.Failed, match="FAILED"):
            export_check.self_test(tmp_path / "law", "gcc", ["-O1", "-Wno-error"])


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler here")
def test_middleware_drives_a_law_that_adapts(tmp_path):
    law = nbs.AdaptiveLaw.for_robot(nbs.load_robot("panda"))
    header = law.export(tmp_path / "law", rate_limit=999.0)
    printed = export_check.middleware(tmp_path / "law", "libfranka/law_law_franka.cpp", FRANKA, None)
    assert printed.startswith("9982 steps")
    export_check.middleware(tmp_path / "law", "ros2_control/law_law_controller.cpp", ROS, ROS_DRIVER)
    text = header.read_text()
    assert "It adapts: load at panda_hand_tcp, viscous friction, Coulomb friction, rotor inertia." in text
    assert "in the frame panda_hand_tcp [m]" in text
    assert "or above 0.001 s" in text


def test_the_self_test_has_the_period_of_the_law(tmp_path):
    law = nbs.AdaptiveLaw.for_robot(nbs.load_robot("two_link"), period=0.0005)
    folder = law.export(tmp_path / "fast_law").parent
    (text,) = (path.read_text() for path in folder.glob("*selftest.c"))
    assert float(re.search(r"real period = which < 5 \* N \? (\S+)", text)[1]) == 0.0005


def test_what_has_no_c_form_is_refused(tmp_path):
    robot = nbs.load_robot("two_link")
    inner = nbs.SlotineLi.for_robot(robot)
    law = nbs.AdaptiveLaw(inner)
    other = type("Other", (nbs.AdaptiveLaw,), {})(inner)
    sliding, wild = nbs.AdaptiveLaw(nbs.SlidingMode.for_robot(robot)), nbs.AdaptiveLaw(inner)
    wild.speed.change.data[0] = np.nan
    with pytest.raises(ArgumentError, match="γ or σ is not finite"):
        wild.compile()
    for each, options, words in (
        (other, {}, "Other has no compiled form"),
        (sliding, {}, "SlidingMode has no compiled form"),
        (law, {"period": 0.002}, "expected at most 0.001 s"),
        (law, {"certificate": nbs.certify(inner, [5.0, 5.0])}, "a law that adapts, of which none is; leave it out"),
        (wild, {}, "not finite; take the law as it was before this training"),
    ):
        with pytest.raises(ArgumentError, match=re.escape(words)):
            each.export(tmp_path / "law", **options)
    assert not (tmp_path / "law").exists()


def test_the_command_exports_a_law_that_adapts(tmp_path, capsys):
    from nbs_pin import cli

    folder, file = tmp_path / "arm", tmp_path / "law.nbs"
    assert cli.main(["export", "two_link", "--law", "adaptive", "--out", str(folder)]) == 0
    export_check.self_test(folder, "gcc", ["-O0"])
    capsys.readouterr()
    code = cli.main(["export", "two_link", "--law", "adaptive", "--disturbance", "5", "--out", str(tmp_path / "more")])
    assert "the law is AdaptiveLaw; omit it" in refusal(code, capsys)
    nbs.save(nbs.AdaptiveLaw(nbs.PD.for_robot(nbs.load_robot("two_link")), ["offsets"]), file)
    assert cli.main(["export", str(file), "--out", str(folder), "--force"]) == 0
    export_check.self_test(folder, "gcc", ["-O0"])
