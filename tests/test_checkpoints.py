"""Controllers on disk: the same to the last bit when they come back, for their own arm, or not at all."""

import io
import os
import re
import shlex
import signal
import subprocess
import sys
import time
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.overrides import TorchFunctionMode

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.archives import read_archive, write_archive
from nbs_pin.base.doors import at_the_shell
from nbs_pin.base.exceptions import ArgumentError, FileFormatError, RobotError, RobotNotFound
from nbs_pin.base.files import ABANDONED, whole_file
from nbs_pin.base.npz import LARGEST
from nbs_pin.base.records import Reference
from nbs_pin.base.versions import versions
from nbs_pin.benchmarks.serial_chains import serial_chain
from nbs_pin.controllers.activations import SmoothedReLU, Squareplus
from nbs_pin.controllers.convex import FICNN
from nbs_pin.controllers.damping import Damping
from nbs_pin.controllers.neural_backstepping import DAMPINGS, NeuralBackstepping, paper_controller
from nbs_pin.controllers.pid import PID
from nbs_pin.controllers.potential import POTENTIALS, Potential
from nbs_pin.controllers.slotine_li import SlotineLi
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.robots.robot import load_robot
from nbs_pin.storage.checkpoints import FORMAT, TrainingState, about, read_checkpoint, write_checkpoint
from tests.laws import EVERY
from tests.test_edited_checkpoints import resealed
from tests.test_networks import randomise

TWO_LINK, PANDA, KINOVA = (load_robot(name) for name in ("two_link", "panda", "kinova"))


def by_hand(robot, activation):
    """Every part built with something other than its default."""
    dynamics, n = PinocchioDynamics(robot), robot.nv
    root = np.random.default_rng(1).normal(size=(n, n))
    potential = Potential(
        root @ root.T + np.eye(n), widths=(5, 3), activation=activation, scale=np.arange(1.0, n + 1),
        least_share=0.25, seed=3,
    )  # fmt: skip
    damping = Damping(
        n, floor=0.1 * np.eye(n), widths=(4,), scale=np.full(n, 0.7), gain=0.5, least_share=0.0, seed=4, ceiling=0.3
    )
    friction = JointFriction(np.full(n, 0.3), np.arange(float(n)), transition=0.02)
    return NeuralBackstepping(
        dynamics, potential, damping, rate=np.full(n, 0.3), inertial_rate=2.0, friction=friction, least_share=0.9
    )


LAWS = {
    **{
        f"nbs_{form}_{damping}": lambda robot, form=form, damping=damping: NeuralBackstepping.for_robot(
            robot, potential=form, damping=damping, least_share=0.2
        )
        for form in POTENTIALS
        for damping in DAMPINGS
    },
    **{f"by_hand_{x}": partial(by_hand, activation=x) for x in (SmoothedReLU(0.2), Squareplus(0.3))},
    "paper": lambda robot: paper_controller(PinocchioDynamics(robot), m=0.3),
    "friction": lambda robot: SlotineLi.for_robot(robot, friction=JointFriction.of(robot)),
    **EVERY,
}


def torques(controller, rows=20):
    """Torques in random states; of a law with memory, after three steps."""
    rng = np.random.default_rng(5)
    q, v, q_ref, v_ref, a_ref = rng.normal(scale=2.0, size=(5, rows, controller.nv))
    memory = controller.initial_memory(q)
    for _ in range(3):
        tau, memory = controller.step(memory, q, v, Reference(q_ref, v_ref, a_ref), 0.001)
    return tau


def scrambled(controller, seed=0):
    randomise(controller, seed)
    return controller


def saved(path, robot=TWO_LINK, **settings):
    nbs.save(scrambled(NeuralBackstepping.for_robot(robot, **settings)), path)
    return path


@pytest.fixture
def path(tmp_path):
    return saved(tmp_path / "arm.nbs")


@pytest.mark.parametrize("robot", [TWO_LINK, PANDA, KINOVA], ids=lambda r: r.name)
@pytest.mark.parametrize("law", LAWS)
def test_a_controller_comes_back_to_the_last_bit(tmp_path, law, robot):
    controller = scrambled(LAWS[law](robot))
    nbs.save(controller, tmp_path / "arm.nbs")
    again = nbs.load(tmp_path / "arm.nbs")
    assert type(again) is type(controller)
    np.testing.assert_array_equal(torques(again), torques(controller))
    np.testing.assert_array_equal(torques(again.compile()), torques(controller.compile()))
    before, after = controller.state_dict(), again.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert [p.requires_grad for p in again.parameters()] == [True] * len(list(controller.parameters()))
    assert [path.name for path in tmp_path.iterdir()] == ["arm.nbs"]


@pytest.mark.parametrize("robot", [None, TWO_LINK], ids=["no_robot", "robot"])
def test_equations_in_closed_form_come_back(tmp_path, robot):
    controller = paper_controller(AnalyticDynamics((2.0, 1.0), (0.5, 1.5), 1.62, robot))
    nbs.save(controller, tmp_path / "arm.nbs")
    again = nbs.load(tmp_path / "arm.nbs", robot)
    np.testing.assert_array_equal(torques(again), torques(controller))
    assert again.dynamics.robot is robot


def test_the_random_numbers_of_others_are_left_alone(path):
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    nbs.save(nbs.load(path), path)
    assert torch.equal(torch.rand(3), expected)


def test_what_a_file_says_of_itself(tmp_path):
    controller = NeuralBackstepping.for_robot(PANDA)
    nbs.save(controller, tmp_path / "arm.nbs", info={"seed": 7})
    said = about(tmp_path / "arm.nbs")
    assert (said["info"], said["versions"]) == ({"seed": 7}, versions())
    assert said["controller"]["dynamics"]["robot"]["sha256"] == PANDA.sha256
    with zipfile.ZipFile(tmp_path / "arm.nbs") as archive:
        assert archive.namelist() == ["manifest.json", "controller.json", "controller.safetensors"]
        assert archive.testzip() is None


def test_the_same_controller_is_the_same_file(tmp_path):
    files = [saved(tmp_path / name).read_bytes() for name in ("one.nbs", "two.nbs")]
    assert files[0] == files[1]


class FarAway(TorchFunctionMode):
    """Every tensor as if it lay on another device, where `.numpy()` is refused unless it fetches."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func is torch.Tensor.numpy and not kwargs.get("force"):
            raise TypeError("can't convert a tensor on another device to numpy")
        return func(*args, **kwargs)


@pytest.mark.parametrize("law", LAWS)
def test_weights_are_fetched_from_another_device(tmp_path, law):
    controller = scrambled(LAWS[law](TWO_LINK))
    expected = torques(controller)
    with FarAway():
        with pytest.raises(TypeError, match="another device"):
            torch.zeros(2).numpy()
        np.testing.assert_array_equal(torques(controller), expected)
        np.testing.assert_allclose(torques(controller.compile()), expected, rtol=1e-9, atol=1e-9)
        nbs.save(controller, tmp_path / "arm.nbs")
    np.testing.assert_array_equal(torques(nbs.load(tmp_path / "arm.nbs")), expected)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
@pytest.mark.parametrize("law", LAWS)
def test_a_controller_on_a_gpu_gives_the_same_torques(tmp_path, law):
    controller = scrambled(LAWS[law](TWO_LINK))
    expected = torques(controller)
    controller.to("cuda")
    np.testing.assert_allclose(torques(controller), expected, rtol=1e-12)
    np.testing.assert_allclose(torques(controller.compile()), expected, rtol=1e-9, atol=1e-9)
    nbs.save(controller, tmp_path / "arm.nbs")
    np.testing.assert_allclose(torques(nbs.load(tmp_path / "arm.nbs")), expected, rtol=1e-12)


# The arm


def arm_of(law):
    return law.robot if isinstance(law, PID) else law.dynamics.robot


@pytest.mark.parametrize("law", [NeuralBackstepping, PID])
def test_effort_limits_come_back_unless_an_arm_is_given(path, law):
    weak = PANDA.with_effort_limit([50.0, 60.0, 70.0, np.inf, 8.0, 9.0, 10.0])
    nbs.save(law.for_robot(weak), path)
    again = arm_of(nbs.load(path))
    assert (again.sha256, again.effort_limit.tolist()) == (PANDA.sha256, weak.effort_limit.tolist())
    assert arm_of(nbs.load(path, PANDA)) is PANDA


def test_the_arm_is_loaded_as_it_was(tmp_path):
    robot = load_robot("panda", gravity=1.62, lock=["panda_finger_joint1", "panda_finger_joint2", "panda_joint7"])
    saved(tmp_path / "arm.nbs", robot)
    assert nbs.load(tmp_path / "arm.nbs").dynamics.robot.sha256 == robot.sha256


@pytest.mark.parametrize("law", [NeuralBackstepping, PID])
@pytest.mark.parametrize(
    ("own", "other"),
    [
        ("panda", load_robot("ur5")),
        ("panda", load_robot("panda", gravity=1.62)),
        ("panda", load_robot("xarm7")),
        ("ur5", load_robot("ur10")),
    ],
)
def test_another_arm_is_refused(path, own, other, law):
    nbs.save(law.for_robot(load_robot(own)), path)
    typed = rf"load_robot\('{other.name}'{', gravity=.*' * ('gravity' in other.options)}\)"
    words = (
        rf"is for the arm '{own}', load_robot\('{own}'\) .* and {typed} .* has other links, joints, limits or gravity"
    )
    with pytest.raises(ArgumentError, match=words):
        nbs.load(path, other)


def test_an_arm_with_other_options_is_refused_with_those_to_give(path):
    own = load_robot("panda", gravity=1.62, lock={"panda_joint7": 0.5})
    saved(path, own)
    locked = "'panda_finger_joint1': 0.0, 'panda_finger_joint2': 0.0, 'panda_joint7': 0.5"
    given = re.escape(f"load_robot('panda', gravity=[0.0, 0.0, -1.62], lock={{{locked}}})")
    with pytest.raises(ArgumentError, match=f"is for the arm 'panda', {given}"):
        nbs.load(path, PANDA)
    words = "panda --gravity 0.0,0.0,-1.62 --lock panda_finger_joint1,panda_finger_joint2,panda_joint7=0.5 "
    with at_the_shell(), pytest.raises(ArgumentError, match=f"is for the arm 'panda', {words}"):
        nbs.load(path, PANDA)
    flags = shlex.split(words)
    typed = cli.parse(["track", *flags])
    assert load_robot(typed.robot, **typed.arm.given()).sha256 == own.sha256


def test_a_pid_by_hand_is_for_its_number_of_joints(tmp_path):
    pid = PID(kp=np.full(7, 50.0), ki=20.0, kd=10.0, effort_limit=np.inf)
    nbs.save(pid, tmp_path / "arm.nbs")
    again = nbs.load(tmp_path / "arm.nbs", PANDA)
    np.testing.assert_array_equal(torques(again), torques(pid))
    assert again.robot is None
    with pytest.raises(ArgumentError, match="is for 7 joints and ur5 has 6"):
        nbs.load(tmp_path / "arm.nbs", load_robot("ur5"))
    with pytest.raises(ArgumentError, match="the gains are for 7 joints and two_link has 2"):
        PID(kp=np.full(7, 50.0), ki=20.0, kd=10.0, effort_limit=np.inf, robot=TWO_LINK)


@pytest.mark.parametrize("joints", [1, 2])
def test_an_arm_whose_file_is_gone_is_asked_for(path, joints):
    robot = serial_chain(joints)
    controller = scrambled(NeuralBackstepping.for_robot(robot))
    nbs.save(controller, path)
    words = (
        rf"is of the arm load_robot\('.*chain_{joints}.urdf'\), which is not there; put it back, or give it as robot="
    )
    with pytest.raises(RobotNotFound, match=words):
        nbs.load(path)
    np.testing.assert_array_equal(torques(nbs.load(path, robot)), torques(controller))


def test_an_arm_loaded_with_options_that_this_version_does_not_know_is_asked_for(path):
    edited = resealed(path, lambda d, _: d["controller"]["dynamics"]["robot"]["options"].update(spin=1))
    with pytest.raises(FileFormatError, match=r"edited.nbs: .*options that this version does not know .*; give it as"):
        nbs.load(edited)


def test_an_arm_whose_file_has_changed_is_refused(tmp_path):
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(Path(TWO_LINK.urdf.path).read_text())
    saved(tmp_path / "arm.nbs", load_robot(urdf))
    urdf.write_text(urdf.read_text().replace('<mass value="1', '<mass value="2'))
    with pytest.raises(RobotError, match="that file was changed"):
        nbs.load(tmp_path / "arm.nbs")


# What cannot be saved leaves the old file alone


def own(kind):
    """A class of a user's own, the same in all but name."""
    return type(f"Own{kind.__name__}", (kind,), {})


def own_network():
    controller = paper_controller(AnalyticDynamics())
    controller.potential.network.__class__ = own(FICNN)
    return controller


def not_a_number():
    controller = paper_controller(AnalyticDynamics())
    controller.damping.diagonal.w0.data[0, 0] = np.nan
    return controller


def changed_share():
    controller = SlotineLi.for_robot(TWO_LINK)
    controller.gains["rate"].least_share.fill_(0.5)
    return controller


def law(potential=None, friction=None):
    potential = potential or Potential(np.eye(2))
    return NeuralBackstepping(AnalyticDynamics(), potential, Damping(2, floor=np.eye(2)), friction=friction)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: own(SlotineLi).for_robot(TWO_LINK), "a OwnSlotineLi cannot be stored"),
        (lambda: paper_controller(own(AnalyticDynamics)()), "a OwnAnalyticDynamics cannot be stored"),
        (lambda: law(own(Potential)(np.eye(2))), "a OwnPotential cannot be stored"),
        (lambda: law(Potential(np.eye(2), activation=own(Squareplus)())), "a OwnSquareplus cannot be stored"),
        (lambda: law(friction=own(JointFriction)(np.ones(2), np.ones(2))), "a OwnJointFriction cannot be stored"),
        (lambda: paper_controller(AnalyticDynamics()).compile(), "a CompiledController cannot be stored"),
        (own_network, "a OwnFICNN cannot be stored in place of a FICNN"),
        (not_a_number, r"tensor 'damping.diagonal.w0' has 1 numbers that are not finite"),
        (changed_share, r"tensor 'gains.rate.least_share' is not what its constructor makes"),
        (lambda: paper_controller(AnalyticDynamics()).float(), r"is .*float32, expected .*float64"),
    ],
)
def test_what_cannot_come_back_is_not_saved(path, make, message):
    before = path.read_bytes()
    with pytest.raises(ArgumentError, match=message):
        nbs.save(make(), path)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["arm.nbs"]


@pytest.mark.parametrize("fact", [np.nan, np.inf, {1, 2}, Path("x")], ids=repr)
def test_notes_that_json_cannot_say_are_refused(path, fact):
    with pytest.raises(ArgumentError, match="cannot be stored as JSON"):
        nbs.save(PID.for_robot(TWO_LINK), path, info={"fact": fact})
    with pytest.raises(ArgumentError, match="cannot be stored as JSON"):
        write_checkpoint(path, PID.for_robot(TWO_LINK), TrainingState({}, {"fact": fact}))
    with pytest.raises(ArgumentError, match="'x' of the training is not finite"):
        write_checkpoint(path, PID.for_robot(TWO_LINK), TrainingState({"x": torch.tensor(torch.inf)}))
    assert isinstance(nbs.load(path), NeuralBackstepping)


# Damage


def test_a_flipped_byte_anywhere_is_refused(path):
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    names = int.from_bytes(content[-64 - 6 : -64 - 2], "little")  # where the directory of the archive begins
    positions = [*rng.integers(0, len(content), 200), *range(names, len(content)), *range(60)]
    for position in positions:
        damaged = bytearray(content)
        damaged[position] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError, match=r"arm.nbs: .*; (take|write) "):
            nbs.load(path)


def test_a_file_cut_or_drawn_out_anywhere_is_refused(path):
    content = path.read_bytes()
    rng = np.random.default_rng(1)
    for length in [0, 1, len(content) - 1, *rng.integers(0, len(content), 200)]:
        path.write_bytes(content[:length])
        with pytest.raises(FileFormatError, match=r"arm.nbs: (not an intact|was changed after)"):
            nbs.load(path)
    for more in (b"\0", content, rng.bytes(100)):
        for longer in (content + more, more + content):
            path.write_bytes(longer)
            with pytest.raises(FileFormatError):
                nbs.load(path)


def test_the_damaged_entry_is_named(path):
    content = path.read_bytes()
    for name, byte in {"controller.json": b'"kind"', "controller.safetensors": b'"dtype"'}.items():
        path.write_bytes(content.replace(byte, byte.upper(), 1))
        with pytest.raises(FileFormatError, match=name):
            nbs.load(path)


class Payload:
    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return Path.touch, (self.marker,)


@pytest.mark.parametrize("kind", ["pickle", "text", "zip", "run", "bomb", "huge"])
def test_other_files_are_refused(tmp_path, kind):
    path, marker = tmp_path / "other.nbs", tmp_path / "marker"
    if kind == "pickle":
        torch.save({"weights": Payload(marker)}, path)
    elif kind == "text":
        path.write_text("weights\n" * 1000)
    elif kind == "run":
        np.savez(npz := io.BytesIO(), q=np.zeros(3))
        path.write_bytes(npz.getvalue())
    elif kind == "huge":
        with path.open("wb") as file:
            file.truncate(LARGEST + 1)
    else:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED if kind == "bomb" else zipfile.ZIP_STORED) as archive:
            archive.writestr("controller.json", bytes(10**7) if kind == "bomb" else "{}")
    with pytest.raises(
        FileFormatError, match=r"other.nbs: (no .nbs_pin checkpoint 1. file|the format|not an intact|has \d+ bytes)"
    ):
        nbs.load(path)
    assert not marker.exists()


def test_no_file_is_no_file(tmp_path):
    with pytest.raises(FileNotFoundError):
        nbs.load(tmp_path / "none.nbs")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda _, t: t.update(more=torch.zeros(2)), "tensor 'more' is superfluous"),
        (lambda _, t: t.pop("potential.network.b1"), r"tensor 'potential.network.b1' is missing"),
        (lambda _, t: t.pop("potential.network.wx0"), r"there is no tensor 'network.wx0'"),
        (lambda _, t: t.pop("rate.nominal"), r"there is no tensor 'rate.nominal'"),
        (lambda _, t: t.update({"damping.lower.w1": torch.zeros(3, 3)}), r"'damping.lower.w1' is \(3, 3\).*expected"),
        (lambda _, t: t.update({"rate.change": t["rate.change"].float()}), "is .*float32, expected .*float64"),
        (lambda _, t: t["potential.network.wy1"].__setitem__(0, torch.nan), "has 32 numbers that are not finite"),
        (lambda _, t: t["rate.nominal"].neg_(), "give 2 positive numbers"),
        (lambda _, t: t["rate.nominal"].fill_(torch.inf), "give 2 positive numbers"),
        (lambda _, t: t["potential.stiffness.nominal"].neg_(), "give a positive definite matrix"),
        (lambda _, t: t["potential.stiffness.least_share"].fill_(1.5), "give a finite number ≥ 0 and < 1"),
        (lambda _, t: t["damping.scale"].zero_(), "give 2 positive numbers"),
        (lambda d, _: d["controller"].update(kind="Sorcery"), "kind 'Sorcery' is unknown"),
        (lambda d, _: d["controller"].update(kind=["PID"]), "is unknown"),
        (lambda d, _: d["controller"].update(apha=1.0), "'apha' of NeuralBackstepping is unknown"),
        (lambda d, _: d["controller"].pop("friction"), "'friction' of NeuralBackstepping is missing"),
        (lambda d, _: d["controller"].update(inertial_rate="fast"), "do not form a controller"),
        (lambda d, _: d["controller"].update(inertial_rate=-1.0), "give a finite number ≥ 0"),
        (lambda d, _: d["controller"]["potential"].update(form="rough"), "form .rough. is unknown"),
        (lambda d, _: d["controller"]["potential"]["activation"].update(b=-1.0), "give a finite number > 0"),
        (lambda d, _: d["controller"].update(potential=None), "do not form a controller"),
        (lambda d, _: d["controller"].update(dynamics=d["controller"]["potential"]["activation"]), "do not form a"),
        (lambda d, _: d["controller"]["dynamics"].update(robot={"kind": "Squareplus", "b": 1.0}), "is a Squareplus"),
        (lambda d, _: d["controller"]["dynamics"].update(robot=None), "do not form a controller"),
        (lambda d, _: d["controller"]["dynamics"]["robot"].update(sha256=1), "'sha256' of the arm is 1"),
        (lambda d, _: d["controller"]["dynamics"]["robot"].update(effort_limit=[1.0]), "effort limit is"),
        (
            lambda d, _: d["controller"]["dynamics"]["robot"]["options"].update(gravity=[1.0, 2.0]),
            r"gravity is .1.0, 2.0.",
        ),
        (lambda d, _: d.update(controller=[]), "kind None is unknown"),
        (lambda d, _: d.update(controller=d["controller"]["potential"]), "a Potential is neither a controller"),
        (lambda d, _: d.update(controller=d["controller"]["dynamics"]["robot"]), "a Robot is neither a controller"),
    ],
)
def test_contents_that_make_no_controller_are_refused(path, change, message):
    with pytest.raises(FileFormatError, match=rf"edited.nbs: .*{message}.*; save the controller again"):
        nbs.load(resealed(path, change))


@pytest.mark.parametrize("size", [1e13, 1e20, 1e308])
def test_weights_that_overflow_are_refused(path, size):
    """Each number is finite, and what the layers make of them is not."""
    for name in ("potential.network.wx0", "damping.lower.w1", "rate.nominal"):
        with pytest.raises(FileFormatError, match=rf"edited.nbs: .*tensor '{name}' has .* beyond 1e\+12|overflow"):
            nbs.load(resealed(path, lambda _, t, name=name: t[name].fill_(size)))


def test_settings_that_overflow_are_refused(tmp_path):
    law = nbs.PID.for_robot(TWO_LINK)
    nbs.save(law, tmp_path / "pid.nbs")
    for name, value in (("filter_time", [1.0]), ("filter_time", 1e308)):
        edited = resealed(tmp_path / "pid.nbs", lambda d, _, n=name, v=value: d["controller"].update({n: v}))
        try:
            torque, _ = nbs.load(edited).step(
                law.initial_memory(np.zeros(2)), np.ones(2), np.ones(2), nbs.Reference(*np.zeros((3, 2))), 1e-3
            )
        except FileFormatError:
            continue
        assert np.isfinite(torque).all()


UNREADABLE = ['{"a": 1, "a": 2}', '{"a": NaN}', '{"a": 1e999}', "", "[" * 100_000, '{"a": ' + "9" * 5000 + "}"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        *((text, "' cannot be read as JSON") for text in UNREADABLE),
        ("[1]", "' is a list"),
        ('{"controller": 1, "versions": 1, "info": 1, "more": 1}', " has .*, expected other keys"),
        ('{"controller": 1, "info": 1}', " has .*, expected other keys"),
    ],
)
def test_json_that_we_do_not_write_is_refused(path, text, message):
    write_archive(path, FORMAT, read_archive(path, FORMAT) | {"controller.json": text.encode()})
    with pytest.raises(FileFormatError, match=f"controller.json{message}"):
        nbs.load(path)


def test_entries_and_formats_that_are_not_ours_are_refused(path):
    entries = read_archive(path, FORMAT)
    write_archive(path, "nbs_pin checkpoint 9", entries)
    with pytest.raises(FileFormatError, match="the format is 'nbs_pin checkpoint 9', expected 'nbs_pin checkpoint 1'"):
        nbs.load(path)
    for wrong in ({**entries, "code.py": b""}, {**entries, "training.json": b"{}"}, {"controller.json": b"{}"}, {}):
        write_archive(path, FORMAT, wrong)
        with pytest.raises(FileFormatError, match="not the entries of a checkpoint"):
            nbs.load(path)
    write_archive(path, FORMAT, {**entries, "controller.safetensors": b"\xff" * 20})
    with pytest.raises(FileFormatError, match=r"'controller.safetensors' is damaged"):
        nbs.load(path)


# Training that goes on: bit for bit in test_training.py


def test_a_training_keeps_the_kinds_of_its_tensors(tmp_path):
    tensors = {
        "moment": torch.randn(3, 2, dtype=torch.float64).T,
        "step": torch.tensor(3.0),
        "random": torch.get_rng_state(),
        "count": torch.arange(3),
        "mask": torch.tensor([True, False]),
        "none": torch.zeros(0, 4),
    }
    write_checkpoint(tmp_path / "t.ckpt", PID.for_robot(TWO_LINK), TrainingState(tensors, {"best": None, "n": 2**100}))
    assert isinstance(nbs.load(tmp_path / "t.ckpt"), PID)
    training = read_checkpoint(tmp_path / "t.ckpt").training
    assert training.facts == {"best": None, "n": 2**100}
    assert training.tensors.keys() == tensors.keys()
    for name, x in tensors.items():
        assert training.tensors[name].dtype == x.dtype
        assert torch.equal(training.tensors[name], x)
    assert read_checkpoint(saved(tmp_path / "arm.nbs")).training is None


# Killed while writing

WRITER = """
import os, signal, sys
import torch
import nbs_pin as nbs
torch.set_num_threads(1)
controller = nbs.paper_controller(nbs.AnalyticDynamics())
nbs.save(controller, sys.argv[1], info={"count": 0})
print("ready", flush=True)
for _ in sys.stdin:  # every line asks for one more writer
    child = os.fork()
    if child == 0:
        count = 0
        while True:
            count += 1
            with torch.no_grad():
                for parameter in controller.parameters():
                    parameter.fill_(count)
            nbs.save(controller, sys.argv[1], info={"count": count})
    print(child, flush=True)
    print(os.waitpid(child, 0)[1], flush=True)
"""


def test_a_writer_killed_at_any_moment_leaves_a_whole_file(tmp_path):
    path = tmp_path / "arm.nbs"
    writer = subprocess.Popen(
        [sys.executable, "-c", WRITER, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with writer:
        assert writer.stdout.readline() == "ready\n"
        rng, counts = np.random.default_rng(0), []
        for _ in range(20):
            writer.stdin.write("more\n")
            writer.stdin.flush()
            child = int(writer.stdout.readline())
            time.sleep(rng.uniform(0.02, 0.15))
            os.kill(child, signal.SIGKILL)
            assert int(writer.stdout.readline()) == signal.SIGKILL
            counts.append(about(path)["info"]["count"])
            weights = {float(x) for p in nbs.load(path).parameters() for x in p.detach().flatten()}
            assert counts[-1] == 0 or weights == {counts[-1]}
        writer.stdin.close()
    assert writer.returncode == 0
    assert len(set(counts)) > 1


def test_drafts_of_killed_writers_are_cleared_away(tmp_path):
    names = [".arm.nbs.0123abcd.tmp", ".arm.nbs.4567abcd.tmp", ".arm.nbs.notes.tmp", ".leg.nbs.0123abcd.tmp"]
    old, young, *others = [tmp_path / name for name in names]
    for draft in (old, young, *others):
        draft.write_bytes(b"half")
    folder = tmp_path / ".arm.nbs.89ababcd.tmp"
    folder.mkdir()
    for draft in (old, *others, folder):
        os.utime(draft, (time.time() - 2 * ABANDONED,) * 2)
    with whole_file(tmp_path / "arm.nbs") as file:
        file.write(b"whole")
    assert not old.exists()
    assert young.exists()
    assert folder.is_dir()
    assert all(other.exists() for other in others)
