"""`nbs-pin certify` and `reproduce --part certificates`: what they write, print and refuse."""

import contextlib
import csv
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.records import Run
from nbs_pin.base.versions import versions
from nbs_pin.certificates import attack as attacking
from nbs_pin.certificates.certify import certify
from nbs_pin.certificates.claims import Assumption
from nbs_pin.certificates.loads import gravity_error, payload, total
from nbs_pin.certificates.transient_search import TransientSearch
from nbs_pin.commands import certify as certifying, certify_adaptive
from nbs_pin.reproduction import certificate_poses, certificate_study
from nbs_pin.robots.catalogue import find

LOADS = ("--unknown-payload", "0.5", "--friction", "0.1,0.2", "--gravity-error", "0.2")
GANTRY = Path(__file__).parent / "data" / "gantry.urdf"
PNG = b"\x89PNG"


def run(folder, controller, *options):
    return cli.main(["certify", controller, "-v", "--out", str(folder), *options])


def summary(folder):
    return json.loads((folder / "summary.json").read_text())


def figures_of(folder, controller, *options):
    assert run(folder, controller, *options) == 0
    return summary(folder)["figures"]


@pytest.fixture
def heavier(tmp_path):
    """The URDF of two_link with heavier links."""
    path = tmp_path / "heavier.urdf"
    path.write_text(find("two_link").path.read_text().replace('mass value="1', 'mass value="1.01'))
    return str(path)


@pytest.fixture(scope="module", autouse=True)
def wide():
    """A terminal in which every row of a table fits on a line."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "260")
        yield


@pytest.fixture(scope="module")
def certified(tmp_path_factory):
    """Where two_link was certified under 5 N·m and loads, and what was printed."""
    folder, printed = tmp_path_factory.mktemp("certified") / "two_link", io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert run(folder, "two_link", "--disturbance", "5,4", *LOADS, "--start-error", "0.1") == 0
    return folder, printed.getvalue()


def test_the_summary_is_what_certify_says(certified):
    said, robot = summary(certified[0]), nbs.load_robot("two_link")
    assert sorted(path.name for path in certified[0].iterdir()) == sorted(certifying.FILES)
    assert said["versions"] == versions()
    assert said["robot_sha256"] == robot.sha256
    assert said["settings"]["disturbance"] == "5,4"
    controller, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    loads = (payload(robot, 0.5, reference), gravity_error(robot, 0.2, reference))
    friction = nbs.JointFriction(np.full(2, 0.1), np.full(2, 0.2))
    admissible = total(certifying.box_or_ball([5.0, 4.0], 2, norm=False), *loads)
    start = reference(0.0).q + np.array([0.1, -0.1])
    task = {"reference": reference, "q0": start, "period": 0.001, "robot": robot}
    expected = certify(controller, admissible, **task, friction=friction)
    figures = said["figures"]
    assert figures["certificate"] == expected.summary()
    assert figures["certificate"]["overshoot_rad"] > figures["certificate"]["error_rad"]
    assert figures["disturbance_label"] == "EMPIRICAL"
    assert figures["certificate"]["joints"] == ["joint1", "joint2"]


def test_every_arm_within_a_share_of_the_model_is_certified(tmp_path):
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert run(tmp_path / "two_link", "two_link", "--inertia-within", "5%") == 0
    found = summary(tmp_path / "two_link")["figures"]["certificate"]
    robot = nbs.load_robot("two_link")
    known = {"reference": nbs.Sinusoid.for_robot(robot), "uncertainty": nbs.Uncertainty(inertia=0.05)}
    expected = certify(nbs.NeuralBackstepping.for_robot(robot), [0.0, 0.0], period=0.001, **known)
    assert found["label"] == "PROVED"
    assert found["joint_errors_rad"] == expected.summary()["joint_errors_rad"]
    assert "errors of the bodies" in printed.getvalue()


def test_the_worst_motion_is_written_and_below_the_bound(certified):
    folder, found = certified[0], summary(certified[0])["figures"]["attack"]
    motion = Run.load(folder / "run.npz")
    assert np.linalg.norm(motion.q - motion.q_ref, axis=-1).max() == pytest.approx(found["error_rad"], rel=1e-12)
    assert 0.0 < found["error_rad"] < summary(folder)["figures"]["certificate"]["error_rad"]
    assert found["certified_over_found"] > 1.0
    assert not found["thorough"]
    assert (folder / "certificate.png").read_bytes().startswith(PNG)


def tables(printed):
    """The rows of every table by its heading: the words of a row in columns, rows that go on below joined to it."""
    found, rows, heading = {}, [], ""
    for line in printed.splitlines():
        if line.startswith(("  ", " ─")) and heading:
            cells = [cell.strip() for cell in re.split(r"\s{3,}", line.strip())]
            if not line.startswith(" ─") and cells != [""]:
                rows.append(cells)
        elif line.strip():
            heading, rows = line.strip(), []
            found[heading] = rows
    return found


def row_of(rows, name):
    """The one row that begins with the name."""
    (row,) = [cells for cells in rows if cells[0] == name]
    return row


def test_the_table_says_everything_once(certified):
    folder, printed = certified
    figures, found = summary(folder)["figures"], tables(printed)
    certificate, worst = figures["certificate"], figures["attack"]
    order = ["errors", "assumptions", "conditions", "disturbance", "friction", "bounds", "sampled control", "inertia"]
    order += ["constants", "structure"]
    assert [heading for heading in found if heading in order] == order
    errors = [line for line in certificate["lines"] if line["unit"] == "rad"]
    claims = [(line, found["errors" if line in errors else line["group"]]) for line in certificate["lines"]]
    for line, rows in claims:
        row = row_of(rows, line["name"])
        assert row[1] == f"{line['value']:.3g} {line['unit']}".strip()
        assert line["label"] in row
        assert printed.count(f"  {line['name']}   ") == 1
    for line in certificate["assumptions"]:
        assert row_of(found["assumptions"], line["assumption"])[1] == line["checked"]
    for condition in certificate["conditions"]:
        row = row_of(found["conditions"], condition["name"])
        left, right = ("none" if condition[x] is None else f"{condition[x]:.3g}" for x in ("left", "right"))
        holds = "yes" if condition["holds"] else "not shown"
        assert condition["holds"] or condition["role"] == "comparison"
        assert row[1:] == [left, f"{right} {condition['unit']}".strip(), holds, condition["label"]]
        assert [condition["because"]] in found["conditions"]
    bounds = [certificate["error_rad"], *certificate["joint_errors_rad"]]
    names = ["‖z1‖", *(f"|z1| of {joint}" for joint in certificate["joints"])]
    for name, bound, x in zip(names, bounds, [worst["error_rad"], *worst["joint_errors_rad"]], strict=True):
        assert row_of(found["errors"], name)[1:4] == [f"{bound:.3g} rad", f"{x:.3g}", f"{bound / x:.2f}"]


def test_the_last_words_are_how_it_is_known_and_where_it_is_written(certified):
    folder, printed = certified
    certificate, lines = summary(folder)["figures"]["certificate"], printed.splitlines()
    assert lines[-3:] == [str(folder / name) for name in certifying.FILES]
    assert certificate["label"] == "EMPIRICAL"
    assert lines[-4] == "EMPIRICAL, under the listed assumptions"
    assert lines[-5].startswith("worst found by ")
    assert lines[-5].endswith("waves alone, --attack searches further")


def test_a_motion_beyond_its_bound_is_told_why(tmp_path, capsys):
    """A bound so small that holding the torque for a period without a proof, which it leaves out, disturbs more."""
    assert run(tmp_path / "a", "two_link", "--disturbance", "1e-6", "--period", "0.01") == 3
    figures, printed = summary(tmp_path / "a")["figures"], capsys.readouterr().out
    found = figures["attack"]
    assert figures["certificate"]["label"] == "EMPIRICAL"
    assert any("half a hold" in name for name in figures["certificate"]["void"])
    assert found["exceeds"]
    assert found["certified_over_found"] < 1.0
    assert str(Assumption.TIME) in found["verdict"]
    assert f"BOUND EXCEEDED; the check of this motion against the certificate: {found['verdict']}" in printed


def test_bounds_whose_conditions_fail_are_kept_and_said_to_be_no_promise(tmp_path, capsys):
    """Torques that no motor holds against, under which the adversary's motions diverge."""
    assert run(tmp_path / "a", "two_link", "--disturbance", "1e6") == 3
    figures = summary(tmp_path / "a")["figures"]
    certificate, printed = figures["certificate"], capsys.readouterr().out
    assert certificate["label"] == "EMPIRICAL"
    assert any(name.startswith("effort limit of joint") for name in certificate["void"])
    last = printed.splitlines()[-3]
    assert last.startswith(f"EMPIRICAL: the bounds are void, as these conditions fail: {certificate['void'][0]} (")
    assert re.search(r"effort limit of joint\d > [^;]* \(100 against 1e\+06 N·m\)", last)
    assert figures["attack"] is None
    assert "diverged" in figures["attack_diverged"]
    assert f"no worst motion to compare with the bounds: {figures['attack_diverged']}" in printed
    assert (tmp_path / "a" / "certificate.png").read_bytes().startswith(PNG)


def test_a_sliding_joint_is_certified_in_metres(tmp_path, capsys):
    certificate = figures_of(tmp_path / "a", str(GANTRY), "--disturbance", "5")["certificate"]
    found = tables(capsys.readouterr().out)
    assert {"m", "rad"} == set(certificate["units"])
    columns = zip(certificate["joints"], certificate["units"], certificate["joint_errors_rad"], strict=True)
    for joint, unit, error in columns:
        assert row_of(found["errors"], f"|z1| of {joint}")[1] == f"{error:.3g} {unit}"


def test_an_attack_finds_more_and_a_run_is_held_against_the_bound(certified, tmp_path, capsys):
    options = ("--disturbance", "5,4", "--attack", "--period", "0.01", "--monitor", str(certified[0] / "run.npz"))
    figures = figures_of(tmp_path / "a", "two_link", *options)
    assert figures["attack"]["thorough"]
    assert figures["attack"]["found_by"] == "bang-bang ascent"
    assert figures["certificate"]["error_rad"] > figures["attack"]["error_rad"]
    assert (tmp_path / "a" / "monitor.png").read_bytes().startswith(PNG)
    # The run's disturbance, 5 N·m and loads, is beyond what was certified.
    assert str(Assumption.DISTURBANCE) in figures["monitor"]["broken"]
    assert isinstance(figures["monitor"]["largest_error_bound_rad"], float)
    printed = " ".join(capsys.readouterr().out.split())
    assert figures["monitor"]["verdict"] in printed
    assert figures["monitor"]["external"].removeprefix("the") in printed
    assert figures["monitor"]["declared_Nm"] == [5.0, 4.0]
    assert max(figures["monitor"]["largest_external_Nm"]) > 5.0
    assert "more than declared" in printed
    assert not figures["monitor"]["is_wrong"]


def test_a_run_of_another_arm_is_refused(certified, tmp_path, capsys, heavier):
    assert run(tmp_path / "a", heavier, "--disturbance", "5", "--monitor", str(certified[0] / "run.npz")) == 2
    assert "the run is of the arm 'two_link'" in capsys.readouterr().err


def test_a_norm_is_a_ball_and_nothing_to_fear_needs_no_adversary(tmp_path):
    ball = figures_of(tmp_path / "a", "two_link", "--disturbance", "5", "--norm")
    assert ball["certificate"]["disturbance"] == "‖τ_d‖ ≤ 5 N·m"
    assert run(tmp_path / "b", "two_link", "--disturbance", "0") == 0
    nothing = summary(tmp_path / "b")["figures"]
    assert nothing["attack"] is None
    assert 0.0 < nothing["certificate"]["error_rad"] < 1e-4  # holding the torque disturbs the loop
    assert not (tmp_path / "b" / "run.npz").exists()


def test_a_wish_becomes_a_controller_that_certifies_it(tmp_path, capsys):
    figures = figures_of(tmp_path / "a", "two_link", "--disturbance", "5", "--wanted", "0.02")
    assert figures["certificate"]["error_rad"] <= 0.02
    period, printed = figures["design"]["period_s"], " ".join(capsys.readouterr().out.split())
    assert f"control period {1e3 * period:g} ms" in printed
    saved = str(tmp_path / "a" / "controller.nbs")
    again = figures_of(tmp_path / "b", saved, "--disturbance", "5", "--period", str(period))
    assert again["certificate"] == figures["certificate"]


def test_a_model_that_is_not_the_arm_is_judged_on_closed_loops_with_it(tmp_path, heavier):
    options = ("--disturbance", "1", "--trajectories", "40", "--against", heavier, "--period", "0.01")
    figures = figures_of(tmp_path / "a", "two_link", *options)
    assert figures["certificate"]["label"] == "PROBABILISTIC"
    assert {"a", "b", "c"} <= {line["name"] for line in figures["certificate"]["lines"]}
    assert "as on 40 closed loops" in figures["certificate"]["assumptions"][0]["assumption"]
    exact = certify(nbs.NeuralBackstepping.for_robot(nbs.load_robot("two_link")), [1.0, 1.0])
    assert figures["certificate"]["error_rad"] > exact.error
    assert figures["attack"]["error_rad"] < figures["certificate"]["error_rad"]


def test_results_of_another_certificate_are_kept(certified, capsys):
    assert run(certified[0], "two_link", "--disturbance", "6") == 2
    assert "of another certificate" in capsys.readouterr().err
    assert run(certified[0], "two_link", "--disturbance", "5,4", *LOADS, "--start-error", "0.1") == 0


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("two_link", "no disturbance was given; give --disturbance"),
        ("two_link --disturbance -1", "--disturbance is '-1'"),
        ("two_link --disturbance 1,2,3", "3 torques were given for 2 joints"),
        ("two_link --disturbance 1,2 --norm", "a norm is one number"),
        ("two_link --norm --unknown-payload 1", "--norm needs --disturbance"),
        ("two_link --disturbance 5 --link tip", "--link needs --unknown-payload"),
        ("two_link --disturbance 5 --margin 2", "--margin needs one of --unknown-payload, --gravity"),
        ("two_link --disturbance 5 --trajectories 9", "--trajectories applies to a model that is not exact"),
        ("two_link --unknown-payload 0", "--unknown-payload is '0'"),
        ("two_link --inertia-within 5", "give a percentage above 0 % and below 100 %"),
        ("two_link --inertia-within 5% --wanted 0.1", "--inertia-within is for the law's own model"),
        ("two_link --delay 0.001 --wanted 0.1", "--delay and --encoder-bits are no part of a design"),
        ("two_link --disturbance 5 --delay 0.002", "delay is 0.002 s, expected 0 to the period of 0.001 s"),
        ("two_link --encoder-bits 0", "give a whole number from 1 to 64"),
        ("two_link --unknown-payload 1 --link moon", "no moving link 'moon'"),
        ("two_link --friction urdf", "--friction is 'urdf'"),
        ("two_link --friction 1", "--friction is '1'"),
        ("two_link --friction 0.1,0.2", "no disturbance was given; give --disturbance"),
        ("law.nbs --disturbance 5 --feed-friction", "--feed-friction is for a law built here"),
        ("two_link --disturbance 5 --wanted 1e-6", "a control period of 0.25 ms forbids it"),
        ("two_link --disturbance 99 --wanted 0.1", "no gains can help"),
        ("law.nbs --disturbance 5 --wanted 0.1", "give an arm"),
        ("two_link --disturbance 5 --reference moon", "no reference 'moon'"),
        ("no_arm --disturbance 5", "no robot 'no_arm'"),
        ("two_link --disturbance 5 --against panda", "the controller has 2 joints and panda 7"),
        ("two_link --disturbance 5 --monitor none.npz", "none.npz"),
        ("two_link --disturbance 5 --payload-radius 0.1", "--payload-radius is for a law that adapts"),
        (
            "two_link --law adaptive --against panda",
            "--against panda is for a law with a fixed model, and two_link has",
        ),
        ("two_link --law adaptive --link moon", "no moving link 'moon'"),
        ("two_link --law adaptive --delay 0.001", "--delay 0.001 is for a law with a fixed model"),
    ],
)
def test_what_cannot_be_meant_is_refused_in_one_sentence(words, expected, tmp_path, capsys):
    assert cli.main(["certify", *words.split(), "--out", str(tmp_path / "a")]) == 2
    said = capsys.readouterr().err.strip()
    assert expected in said
    assert len([line for line in said.splitlines() if "error" in line]) == 1
    assert not (tmp_path / "a").exists()


def test_a_law_that_adapts_is_bounded_beside_the_one_that_does_not(tmp_path, capsys):
    words = ("--law", "adaptive", "--unknown-payload", "0.3", "--payload-radius", "0", "--disturbance", "1", "--report")
    figures = figures_of(tmp_path, "two_link", *words)
    said = capsys.readouterr().out
    robot = nbs.load_robot("two_link")
    expected = nbs.transient_bound(
        nbs.AdaptiveLaw.for_robot(robot), 0.3, disturbance=np.ones(2), reference=nbs.Sinusoid.for_robot(robot)
    )
    found = figures["transient"]
    assert found["joint_errors_rad"] == pytest.approx(expected.joint_errors)
    assert found["joint_errors_always_rad"] == pytest.approx(expected.joint_errors_always)
    assert expected.error_always == pytest.approx(
        expected.error * np.sqrt(expected.storage_always / expected.potential)
    )
    assert found["fixed_joint_errors_rad"] == pytest.approx(expected.fixed.joint_errors)
    assert "PROVED: no joint of two_link strays more than" in said
    assert "whatever it carries up to 0.3 kg at tip" in said
    assert "with a fixed model the worst of two such loads, undisturbed, brings" in said
    row = next(line for line in said.splitlines() if line.split()[:1] == ["joint1"])
    assert f"{found['joint_errors_rad'][0]:.3g} rad" in row
    assert (tmp_path / "certificate.png").read_bytes().startswith(PNG)
    page = (tmp_path / "report.html").read_text()
    assert "fixed model, simulated" in page
    assert "at all times it is below" in page.lower()


def test_the_bound_of_a_law_that_adapts_is_attacked_and_a_run_is_checked(tmp_path, capsys, monkeypatch):
    robot = nbs.load_robot("two_link")
    law = nbs.AdaptiveLaw.for_robot(robot)
    plant = nbs.MujocoPlant(robot.with_payload("link1", 0.2))
    motion = nbs.Sinusoid.for_robot(robot)
    moved = nbs.AdaptiveLaw(law.law, law.adapts, frame="link1")
    nbs.simulate(plant, moved, motion, 1.0, 0.001).save(tmp_path / "seen.npz")
    honest = certify_adaptive.transient_attack
    monkeypatch.setattr(certify_adaptive, "transient_attack", lambda *given, **named: honest(*given, **named, runs=30))
    words = ("--law", "adaptive", "--unknown-payload", "0.3", "--payload-radius", "0.05", "--link", "link1")
    words = (*words, "--start-error", "0.02", "--attack", "--monitor", str(tmp_path / "seen.npz"), "--report")
    figures = figures_of(tmp_path / "a", "two_link", *words)
    said = capsys.readouterr().out
    begin = motion(np.zeros(1)).q[0] + [0.02, -0.02]
    expected = nbs.transient_bound(moved, 0.3, 0.05, reference=motion, q0=begin)
    assert figures["transient"]["joint_errors_rad"] == pytest.approx(expected.joint_errors)
    assert figures["transient"]["frame"] == "link1"
    found, seen = figures["attack"], figures["monitor"]
    assert 20 < found["runs"] <= 30
    assert not found["exceeds"]
    ratios = expected.joint_errors / np.array(found["joint_errors_rad"])
    assert found["bound_over_found"] == pytest.approx(ratios.min())
    assert f"certified ÷ found = {ratios.min():.2f}" in said
    rows = [line.split() for line in said.splitlines() if line.split()[:1] == ["joint1"]]
    assert f"{ratios[0]:.2f}" == rows[1][-1]
    assert "from a start at rest with 0.02 rad" in said
    assert seen["is_kept"]
    assert f"The run: {seen['verdict']}"[4:] in said
    for name in ("certificate.png", "monitor.png"):
        assert (tmp_path / "a" / name).read_bytes().startswith(PNG)
    with open(tmp_path / "a" / "monitor.csv") as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["t", "error_joint1", "error_joint2", "bound_joint1", "bound_joint2"]
    assert len(rows) == 1002
    worst = Run.load(tmp_path / "a" / "run.npz")
    assert expected.check(worst).is_kept
    page = (tmp_path / "a" / "report.html").read_text()
    assert "the worst run found reaches" in page


def test_ctrl_c_in_the_search_keeps_the_results(tmp_path, capsys, monkeypatch):
    honest, rounds = TransientSearch.shares, []

    def shares(self, vectors):
        if rounds:
            raise KeyboardInterrupt
        rounds.append(1)
        return honest(self, vectors)

    monkeypatch.setattr(TransientSearch, "shares", shares)
    words = ("--law", "adaptive", "--unknown-payload", "0.3", "--payload-radius", "0", "--attack")
    assert run(tmp_path / "a", "two_link", *words) == 130
    assert "interrupted" in capsys.readouterr().out.lower()
    found = summary(tmp_path / "a")
    assert found["interrupted"]
    assert found["figures"]["attack"]["runs"] == 40
    assert (tmp_path / "a" / "run.npz").exists()


def test_a_saved_law_that_adapts_keeps_its_own_link(tmp_path, capsys):
    law = nbs.AdaptiveLaw.for_robot(nbs.load_robot("two_link"))
    nbs.save(law, tmp_path / "law.nbs")
    assert run(tmp_path / "a", str(tmp_path / "law.nbs"), "--link", "link1") == 2
    assert "--link is for a law built here" in capsys.readouterr().err


def test_a_law_without_a_proof_is_refused(tmp_path, capsys):
    robot = nbs.load_robot("two_link")
    nbs.save(nbs.PID.for_robot(robot), tmp_path / "pid.nbs")
    nbs.save(nbs.PinocchioDynamics(robot), tmp_path / "model.nbs")
    for name in ("pid", "model"):
        assert run(tmp_path / "a", str(tmp_path / f"{name}.nbs"), "--disturbance", "5") == 3
        assert "error" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("panda --disturbance 5 --reference paper", "with its error leaves the joint limits"),
        ("xarm7 --disturbance 0.1", "joint friction that is not fed forward"),
        ("two_link --disturbance 5 --law pid", "of which no Lyapunov function is known"),
        ("two_link --disturbance 1 --start-error 3", "these conditions fail: effort limit of"),
        ("kinova --disturbance 5", "of no use: a bound of 1.1 turns"),
        (
            "two_link --law adaptive --unknown-payload 9",
            "loads up to 9 kg within 0.1 m are beyond what the law can learn",
        ),
    ],
)
def test_a_promise_that_is_not_given_has_an_exit_code_of_its_own(words, expected, tmp_path, capsys):
    assert cli.main(["certify", *words.split(), "--out", str(tmp_path / "a")]) == 3
    assert expected in " ".join("".join(capsys.readouterr()).split())


def test_friction_can_be_fed_forward(tmp_path):
    figures = figures_of(tmp_path / "a", "xarm7", "--disturbance", "0.1", "--feed-friction")
    assert figures["certificate"]["label"] == "PROVED"


@pytest.fixture(scope="module")
def reproduced(tmp_path_factory):
    """The study, much reduced."""
    folder = tmp_path_factory.mktemp("study")
    scale = certificate_study.Scale(
        arms=("two_link",),
        moduli=(0.5,),
        dampings=(1.0,),
        random=8,
        family=8,
        longest=100,
        rounds=1,
        duration=0.15,
        fine=(14.0, 0.005),
        poses=certificate_poses.Scale(arms=("two_link",), samples=500, climbs=4, sweeps=3),
    )
    return folder, list(certificate_study.reproduce_certificates(folder, scale=scale))


def test_no_bound_of_the_study_is_broken_and_the_papers_is(reproduced):
    folder, sections = reproduced
    figures = {name: value for section in sections for name, value in section.figures.items()}
    rows = figures["certificates"]
    assert [row["violations"] for row in rows] == [0] * len(rows)
    assert {row["label"] for row in rows} == {"PROVED"}
    assert all(row["ratio"] >= 1.0 for row in rows)
    assert figures["inertia_bounds"][0]["outside"] == 0
    assert figures["counterexample"]["gradient_squared_over_d"] == pytest.approx(0.687, abs=0.004)
    assert figures["counterexample"]["error_squared_over_d"] <= figures["counterexample"]["certified_over_d"]
    assert sorted(path.name for path in folder.iterdir()) == sorted(certificate_study.FILES)
    table = list(csv.DictReader((folder / "certificates.csv").read_text(encoding="utf-8").splitlines()))
    assert [float(row["certified_rad"]) for row in table] == [row["certified_rad"] for row in rows]
    assert all(f"{row['ratio']:.2f}" in sections[0].markdown for row in rows)


def test_climbing_poses_reach_beyond_sampled_ones():
    few = certificate_poses.Scale(samples=100, climbs=4, sweeps=4)
    still = certificate_poses.Scale(samples=100, climbs=4, sweeps=0)
    climbed, sampled = (certificate_poses.on_arm("two_link", scale) for scale in (few, still))
    assert climbed.largest_found_kgm2 > sampled.largest_found_kgm2
    assert climbed.least_found_kgm2 < sampled.least_found_kgm2
    assert climbed.outside == sampled.outside == 0


@pytest.mark.parametrize("rounds", [0, 1])
def test_ctrl_c_in_the_search_keeps_the_bound_and_what_was_found(rounds, tmp_path, monkeypatch, capsys):
    ascend, done = attacking._Ascent.ascend, []

    def interrupted(self, *arguments, **settings):
        if len(done) == rounds:
            raise KeyboardInterrupt
        done.append(self)
        return ascend(self, *arguments, **settings)

    monkeypatch.setattr(attacking._Ascent, "ascend", interrupted)
    assert run(tmp_path, "two_link", "--disturbance", "5", "--attack") == 130
    printed = capsys.readouterr()
    assert "the search for the worst motion was interrupted" in " ".join(printed.out.split())
    assert "interrupted" in printed.err
    said, motion = summary(tmp_path), Run.load(tmp_path / "run.npz")
    assert said["interrupted"]
    error = np.linalg.norm(motion.q - motion.q_ref, axis=-1).max()
    assert error == pytest.approx(said["figures"]["attack"]["error_rad"], rel=1e-9)
    assert 0.0 < error < said["figures"]["certificate"]["error_rad"]


def test_ctrl_c_before_any_motion_keeps_the_bound(tmp_path, monkeypatch):
    def interrupted(*arguments, **settings):
        raise KeyboardInterrupt

    monkeypatch.setattr(attacking.LoopEnsemble, "peaks", interrupted)
    assert run(tmp_path, "two_link", "--disturbance", "5") == 130
    said = summary(tmp_path)
    assert said["interrupted"]
    assert said["figures"]["attack"] is None
    assert said["figures"]["certificate"]["label"] == "PROVED"
    assert not (tmp_path / "run.npz").exists()
