"""Laws in C: the torques of Python to rounding, C that no compiler complains of, and nothing else behind it."""

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
from nbs_pin.controllers.registry import build_law
from nbs_pin.dynamics.chain import Chain
from nbs_pin.dynamics.cholesky import CholeskyNetwork
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.export.law import comment
from nbs_pin.export.tracing import as_python
from nbs_pin.kernels.records import Motion
from nbs_pin.kernels.tree_layout import tree_workspace
from nbs_pin.kernels.trees import tree_torque
from tests.commands import check_results_are_kept_unless_forced, refusal
from tests.imitations import FRANKA, ROS, ROS_DRIVER
from tests.laws import COMPILED
from tests.random_arms import random_arm
from tests.test_networks import randomise

sys.path.insert(0, str(Path(__file__).parent.parent / "tools"))
import export_check

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler here")
TWO_LINK, PANDA = nbs.load_robot("two_link"), nbs.load_robot("panda")


def passes(law, folder, **options):
    """Export a law, compile it with every warning as an error, run its self-test, and look at what it links to."""
    law.export(folder, **options)
    export_check.self_test(folder, "gcc", ["-O1"])
    export_check.symbols(folder)


@pytest.mark.parametrize("name", COMPILED)
def test_every_compiled_law_is_the_same_in_c(name, tmp_path):
    friction = {} if name == "pid" else {"friction": JointFriction([0.3, 0.1], [0.5, 0.2])}
    passes(build_law(name, TWO_LINK, **friction), tmp_path / "law", rate_limit=[500.0, np.inf])


def test_no_torque_beyond_the_limits_is_sent_whatever_the_arm_was_sent_last(tmp_path):
    name, limit, compiled = "law_law", TWO_LINK.effort_limit, tmp_path / "law.so"
    nbs.PD.for_robot(TWO_LINK).export(tmp_path / "law", rate_limit=1.0)
    subprocess.run(["gcc", "-shared", "-fPIC", tmp_path / f"law/{name}.c", "-lm", "-o", compiled], check=True)
    library, vector = ctypes.CDLL(str(compiled)), ctypes.c_double * 2
    state, tau, rest = vector(), vector(), vector()  # the law remembers its torque alone
    for last, taken in (
        ([np.nan, 5.0 * limit[1]], [0.0, limit[1]]),
        ([-5.0 * limit[0], -np.inf], [-limit[0], 0.0]),
        ([3.0, -4.0], [3.0, -4.0]),
    ):
        library[f"{name}_start"](state, vector(*last))
        assert list(state) == taken
        assert library[f"{name}_step"](state, rest, rest, rest, rest, rest, ctypes.c_double(0.001), tau) == 0
        assert (np.abs(tau) <= limit).all()
        assert np.abs(np.subtract(tau, taken)).max() <= 0.001 * (1.0 + 1e-9)


def test_the_self_test_fails_for_a_torque_that_is_no_number(tmp_path):
    nbs.PD.for_robot(TWO_LINK).export(tmp_path / "law")
    path = tmp_path / "law" / "selftest.c"
    text = path.read_text()
    head, *rows = text.split("    {{")
    for vector in (5, 6):  # of the law, and sent
        for joint in (0, 1):
            vectors = rows[3].split("},\n     {")
            numbers = vectors[vector].split(", ")
            numbers[joint] = re.sub(r"^[^}]+", "NAN", numbers[joint])
            vectors[vector] = ", ".join(numbers)
            path.write_text("    {{".join([head, *rows[:3], "},\n     {".join(vectors), *rows[4:]]))
            with pytest.raises(export_check.Failed, match="FAILED"):
                export_check.self_test(tmp_path / "law", "gcc", ["-O0"])


@pytest.mark.parametrize("precision", ["double", "float"])
def test_a_whole_law_of_panda_is_the_same_in_c(precision, tmp_path):
    law = nbs.NeuralBackstepping.for_robot(PANDA)
    for part in (law.potential, law.damping):
        randomise(part, 3)
    passes(law.compile(), tmp_path / "law", precision=precision, gravity=precision == "double", rate_limit=999.0)
    if shutil.which("g++") is None:
        pytest.skip("no C++ compiler here")
    printed = export_check.middleware(tmp_path / "law", "libfranka/law_law_franka.cpp", FRANKA, None)
    assert printed.startswith("9982 steps")
    printed = export_check.middleware(tmp_path / "law", "ros2_control/law_law_controller.cpp", ROS, ROS_DRIVER)
    assert printed.split() == [
        "panda_joint1/position", "panda_joint7/velocity", "panda_joint7/effort", "panda_joint7/acceleration"
    ]  # fmt: skip


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler here")
def test_a_pid_for_a_franka_arm_has_no_weight_to_take_off(tmp_path):
    passes(nbs.PID.for_robot(PANDA), tmp_path / "law", rate_limit=999.0)
    printed = export_check.middleware(tmp_path / "law", "libfranka/law_law_franka.cpp", FRANKA, None)
    assert abs(float(printed.split()[2])) < 1e-3  # of a joint without an error


def test_the_effort_limit_of_a_pid_is_the_smaller_of_its_own_and_the_arms(tmp_path):
    gains = {"kp": [900.0, 900.0], "ki": 1.0, "kd": 1.0, "robot": TWO_LINK}
    text = ""
    for own in ([150.0, 30.0], np.inf):
        passes(nbs.PID(**gains, effort_limit=own), tmp_path / "law")
        text += (tmp_path / "law" / "law_law.h").read_text()
    assert re.findall(r"\|tau\| <= (\S+)", text) == ["100", "30", "100", "100"]


def test_without_limits_the_torque_of_the_law_is_sent_to_the_last_digit(tmp_path):
    nbs.PID(kp=[900.0, 900.0], ki=1.0, kd=1.0, effort_limit=np.inf).export(tmp_path / "law")
    rows = (tmp_path / "law" / "selftest.c").read_text().split("    {{")[1:]
    for row in rows:
        *_, law, sent = re.findall(r"[^{}\s][^{}]*(?=\})", row.split("}}")[0] + "}")
        assert law == sent


@pytest.mark.parametrize("seed", [3, 5, 8])
def test_trees_of_every_kind_are_the_same_in_c(seed, tmp_path):
    """Branches, sliding and continuous joints, rotors, friction and a tilted base."""
    robot = random_arm(seed, tmp_path)
    passes(nbs.SlotineLi.for_robot(robot, friction=JointFriction.of(robot)), tmp_path / "law")


def test_a_learned_chain_is_the_same_in_c(tmp_path):
    model = nbs.LagrangianDynamics(Chain([0, 1, 1], [False, True, False]))
    passes(nbs.ComputedTorque(model, kp=np.full(3, 9.0), kd=np.full(3, 6.0)), tmp_path / "law")


def test_kernels_as_python_compute_what_they_compute_as_machine_code():
    tree, rng = nbs.PinocchioDynamics(PANDA).packed_tree(), np.random.default_rng(0)
    motion = Motion(*rng.normal(size=(4, 7)))
    compiled, plain = np.empty((2, 7))
    tree_torque(motion, tree, np.empty(tree_workspace(tree)), compiled)
    as_python(tree_torque, {})(motion, tree, np.empty(tree_workspace(tree)), plain)
    np.testing.assert_allclose(plain, compiled, rtol=1e-13, atol=1e-13)


def test_the_header_states_what_the_certificate_of_this_law_says(tmp_path):
    law = nbs.SlotineLi.for_robot(TWO_LINK)
    certificate = nbs.certify(law, [5.0, 5.0])
    text = law.export(tmp_path / "law", certificate=certificate).read_text()
    assert f"at most {certificate.error:.4g} rad" in text
    assert str(certificate.label) in text
    assert TWO_LINK.sha256 in text
    with pytest.raises(ArgumentError, match="other numbers"):
        nbs.SlotineLi.for_robot(TWO_LINK, bandwidth=9.0).export(tmp_path / "law", certificate=certificate)
    for change in ({"payload": 2.0}, {"limits": {"joint1": {"velocity": 9.0}}}):
        other = nbs.PinocchioDynamics(nbs.load_robot("two_link", **change))
        same_gains = nbs.SlotineLi(other, rate=law.rate, gain=law.gain)
        with pytest.raises(ArgumentError, match="other numbers"):
            same_gains.export(tmp_path / "law", certificate=certificate)
    assert "No certificate" in law.export(tmp_path / "law").read_text()


def test_what_has_no_c_form_is_refused(tmp_path):
    network = nbs.LagrangianDynamics(CholeskyNetwork([False, False]))
    learned = nbs.ComputedTorque(network, kp=np.ones(2), kd=np.ones(2))
    for law, options, words in (
        (nbs.SlidingMode.for_robot(TWO_LINK), {}, "SlidingMode has no compiled form"),
        (learned, {}, "LagrangianDynamics, which is no rigid tree"),
        (nbs.PID.for_robot(TWO_LINK), {"gravity": False}, "a PID has no model"),
        (nbs.PD.for_robot(TWO_LINK), {"rate_limit": [1.0, 2.0, 3.0]}, "rate_limit has 3 numbers, expected 2"),
        (nbs.PD.for_robot(TWO_LINK), {"certificate": "certificate.json"}, "give a Certificate, as certify returns it"),
        (nbs.PD.for_robot(TWO_LINK), {"rate_limit": 0.0}, "rate_limit is 0.0"),
        (nbs.PD.for_robot(TWO_LINK), {"precision": "half"}, "precision 'half' is unknown"),
    ):
        with pytest.raises(ArgumentError, match=re.escape(words)):
            law.export(tmp_path / "law", **options)
    assert not (tmp_path / "law").exists()


def test_files_and_functions_are_called_after_the_folder(tmp_path):
    names = {"panda_law": "panda_law", "double": "double_law", "3 arms": "law_3_arms", "é": "law_law"}
    for folder, name in names.items():
        header = nbs.PID.for_robot(TWO_LINK).export(tmp_path / folder)
        assert header == tmp_path / folder / f"{name}.h"
        assert f" {name}_step(" in header.read_text()
    export_check.self_test(tmp_path / "double", "gcc", ["-O0"])


def test_no_text_ends_a_comment():
    assert comment("a joint */ int x; /* |τ| ≤ 5 N·m\n é") == "a joint * / int x; /* |tau| <= 5 N m  ?"


def test_the_command_exports_and_keeps_another_law(tmp_path, capsys):
    from nbs_pin import cli

    def run(folder, *more):
        return cli.main(["export", "two_link", "--law", "pd-plus", "--out", str(folder), *more])

    check_results_are_kept_unless_forced(run, tmp_path / "arm", ("--bandwidth", "9"), "another law", capsys)
    export_check.self_test(tmp_path / "arm", "gcc", ["-O0"])
    nbs.save(nbs.SlidingMode.for_robot(TWO_LINK), tmp_path / "law.nbs")
    capsys.readouterr()
    assert "no compiled form" in refusal(
        cli.main(["export", str(tmp_path / "law.nbs"), "--out", str(tmp_path)]), capsys
    )
    code = cli.main(["export", "two_link", "--law", "pid", "--without-gravity", "--out", str(tmp_path / "pid")])
    assert "--without-gravity was given, but a PID" in refusal(code, capsys)
