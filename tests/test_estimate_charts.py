"""What an adaptive law believed, in pictures, on pages and in the folder of `nbs-pin track`."""

import base64
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.controllers.unknowns import ADAPTS
from nbs_pin.reports.estimate_panels import CARRIED, panels_of
from nbs_pin.reports.replay import shown_run
from nbs_pin.simulation.run_figures import load_deviation
from tests.commands import contents, printed_by, summary

GANTRY = str(Path(__file__).parent / "data" / "gantry.urdf")  # one joint slides, two turn
LOAD = {"mass_kg": 0.5, "link": "tip", "from_s": 0.2, "until_s": 0.8}


def run_of(robot, adapts, duration=0.4, plant=None, **more):
    law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(robot), adapts, gain=0.1)
    return nbs.simulate(plant or nbs.MujocoPlant(robot), law, nbs.Sinusoid.for_robot(robot), duration, 0.001, **more)


@pytest.fixture(scope="module")
def carried():
    """A load that comes and goes."""
    robot = nbs.load_robot("two_link")
    bare, loaded = nbs.MujocoPlant(robot), nbs.MujocoPlant(robot.with_payload("tip", 0.5))
    plant = nbs.ChangingPlant(bare, [(0.2, loaded), (0.8, bare)])
    run = run_of(robot, ["load", "friction"], 1.0, plant)
    run.info["loads"] = [LOAD]
    return run


def drawn(run, folder, **more):
    """The pixels of the picture."""
    return np.asarray(Image.open(nbs.plot_estimates(run, folder / "estimates.png", **more)).convert("RGB"))


def test_the_panels_of_a_load_are_its_mass_beside_what_was_carried_and_its_centre_while_it_is_there(carried):
    mass, centre, *others = panels_of(carried)
    assert (mass.title, mass.unit) == ("mass of the load at tip", "kg")
    np.testing.assert_array_equal(mass.curves[CARRIED], 0.5 * ((carried.t >= 0.2) & (carried.t < 0.8)))
    assert (centre.title, centre.unit) == ("its centre in the frame of tip", "mm")
    x = centre.curves["x"]
    assert np.isnan(x[:200]).all()
    assert np.isfinite(x[400:800]).all()
    heavy = np.isfinite(x)
    assert (np.abs(mass.curves["learned"][heavy]) > 0.02).all()
    first = carried.estimates[:, carried.info["estimates"].index("load at tip mx [kg·m]")]
    np.testing.assert_allclose(x[heavy], 1e3 * first[heavy] / mass.curves["learned"][heavy])
    assert [panel.title for panel in others] == ["Coulomb friction", "viscous friction"]
    assert all(panel.of_joints and list(panel.curves) == ["joint1", "joint2"] for panel in others)


def test_every_estimate_of_joints_and_links_is_in_one_panel_with_its_unit():
    run = run_of(nbs.load_robot(GANTRY), list(ADAPTS))
    panels = panels_of(run)
    assert [(panel.title, panel.unit, list(panel.curves)) for panel in panels[2:]] == [
        ("mass behind", "kg", ["rail", "hinge"]),
        ("Coulomb friction", "N", ["rail"]),
        ("Coulomb friction", "N·m", ["hinge", "spin"]),
        ("viscous friction", "N·s/m", ["rail"]),
        ("viscous friction", "N·m·s/rad", ["hinge", "spin"]),
        ("rotor inertia", "kg", ["rail"]),
        ("rotor inertia", "kg·m²", ["hinge", "spin"]),
        ("constant torque", "N", ["rail"]),
        ("constant torque", "N·m", ["hinge", "spin"]),
    ]
    names = run.info["estimates"]
    for panel in panels[3:]:
        for joint, curve in panel.curves.items():
            column = names.index(f"{joint} {panel.title} [{panel.unit}]")
            np.testing.assert_array_equal(curve, run.estimates[:, column])


@pytest.mark.parametrize("adapts", [["load"], ["links"], ["friction", "rotors"], ["offsets"], list(ADAPTS)])
@pytest.mark.parametrize("name", ["two_link", GANTRY])
def test_a_picture_has_a_row_for_every_panel(name, adapts, tmp_path):
    run = run_of(nbs.load_robot(name), adapts)
    one = drawn(run_of(nbs.load_robot(name), ["links"]), tmp_path).shape[0]
    assert drawn(run, tmp_path).shape[0] - one == pytest.approx(120 * 1.9 * (len(panels_of(run)) - 1), abs=2)


def test_every_start_has_a_picture_of_its_own_and_other_kinds_are_written(tmp_path):
    robot = nbs.load_robot("two_link")
    run = run_of(robot, ["load"], q0=nbs.Sinusoid.for_robot(robot)(0.0).q + np.array([[0.0, 0.0], [0.3, -0.3]]))
    assert run.estimates.shape == (401, 2, 10)
    assert (drawn(run, tmp_path, start=0) != drawn(run, tmp_path, start=1)).any()
    assert b"<svg" in nbs.plot_estimates(run, tmp_path / "estimates.svg").read_bytes()
    with pytest.raises(ArgumentError, match="start=2 does not exist: the run has starts 0 to 1"):
        nbs.plot_estimates(run, tmp_path / "estimates.png", start=2)


def test_a_run_without_estimates_is_refused_in_one_sentence(tmp_path):
    robot = nbs.load_robot("two_link")
    law = nbs.NeuralBackstepping.for_robot(robot)
    run = nbs.simulate(nbs.MujocoPlant(robot), law, nbs.Sinusoid.for_robot(robot), 0.1, 0.001)
    with pytest.raises(ArgumentError, match=r"^the run has no estimates; plot one of a law that adapts, such as"):
        nbs.plot_estimates(run, tmp_path / "estimates.png")
    assert not (tmp_path / "estimates.png").exists()
    shown = shown_run(run, robot)
    assert (shown["signals"]["estimates"], shown["scene"]["loads"]) == ([], [])


def test_many_joints_of_long_names_leave_room_for_their_curves(tmp_path):
    n, t = 23, np.linspace(0.0, 1.0, 101)
    names = tuple(f"a_very_long_name_of_the_$left_arm_joint_{k}" for k in range(n))
    still = np.zeros((len(t), n))
    run = nbs.Run(
        **dict.fromkeys(("q", "v", "q_ref", "v_ref", "a_ref", "tau", "tau_command", "disturbance"), still),
        t=t, effort_limit=np.ones(n), continuous=np.zeros(n, dtype=bool), joint_names=names, period=0.01,
        robot="made_up", robot_sha256="0" * 64, estimates=np.cumsum(np.ones((len(t), n)), axis=0) * np.arange(n),
        info={"estimates": [f"{name} Coulomb friction [N·m]" for name in names], "controller": "AdaptiveLaw(…)"},
    )  # fmt: skip
    pixels = drawn(run, tmp_path)
    grey = (pixels[:, :, 0] == 0x9A) & (pixels[:, :, 1] == 0xA3) & (pixels[:, :, 2] == 0xAD)  # the axes
    assert grey.sum(axis=1).max() > 0.45 * pixels.shape[1]


def test_pages_have_every_panel_and_the_load_where_it_is_carried(carried):
    robot = nbs.load_robot("two_link")
    shown = shown_run(carried, robot)
    for panel, sent in zip(panels_of(carried), shown["signals"]["estimates"], strict=True):
        told = (panel.title, panel.unit, list(panel.curves), panel.of_joints)
        assert told == tuple(sent[key] for key in ("title", "unit", "names", "of_joints"))
        values = np.frombuffer(base64.b64decode(sent["values"]), "<f4").reshape(len(carried.t), -1)
        np.testing.assert_allclose(values, np.stack(list(panel.curves.values()), axis=-1), rtol=1e-6, atol=1e-30)
    (ball,) = shown["scene"]["loads"]
    assert (ball["from"], ball["until"]) == (0.2, 0.8)
    body, placement = shown["scene"]["links"]["tip"]
    assert ball["body"] == body
    np.testing.assert_allclose(ball["point"], placement[12:15])
    assert 4.0 / 3.0 * np.pi * ball["radius"] ** 3 * 2700.0 == pytest.approx(0.5)


def test_a_load_at_a_link_that_the_arm_does_not_have_is_not_drawn(carried):
    carried.info["loads"] = [{**LOAD, "link": "elsewhere"}, {**LOAD, "com_m": [0.0, 0.0, 0.1]}, {**LOAD, "link": ""}]
    balls = shown_run(carried, nbs.load_robot("two_link"))["scene"]["loads"]
    carried.info["loads"] = [LOAD]
    assert len(balls) == 2
    np.testing.assert_allclose(np.subtract(balls[0]["point"], balls[1]["point"]), [0.0, 0.0, 0.1], atol=1e-12)


def test_a_centre_may_be_off_by_what_mass_and_moment_may_be_off_together():
    """(σ_h + |c|σ_m)/m is the largest deviation of h/m to first order, over all correlations of h and m."""
    moment, mass, off = np.array([0.06, -0.04, 0.0]), 2.0, np.array([0.1, 0.02, 0.01, 0.03])
    names = ["load at tip m [kg]", *(f"load at tip m{axis} [kg·m]" for axis in "xyz")]
    estimates, deviations = dict(zip(names, [mass, *moment], strict=True)), dict(zip(names, off.tolist(), strict=True))
    found = load_deviation(estimates, deviations)
    assert found is not None
    step = 1e-6
    worst = [
        max(abs((h + a * step * s) / (mass + b * step * off[0]) - h / mass) / step for a in (-1, 1) for b in (-1, 1))
        for h, s in zip(moment, off[1:], strict=True)
    ]
    assert found[0] == 0.1
    np.testing.assert_allclose(found[1], worst, rtol=1e-4)
    assert load_deviation(estimates, {}) is None
    assert load_deviation({}, deviations) is None


def test_track_tells_the_load_and_another_law_takes_the_picture_away(tmp_path):
    folder, line = tmp_path / "out", ("track", "two_link", "--duration", "5", "--payload", "0.3@1")
    printed = printed_by(*line, "--controller", "adaptive", "--out", folder)
    assert "the law estimates a load of 0.3 kg at tip" in printed.replace("\n", " ")
    assert str(folder / "estimates.png") in printed.replace("\n", "")
    files = {"run.npz", "tracking.png", "estimates.png", "replay.html", "summary.json"}
    assert contents(folder).keys() == files
    learned, off = (summary(folder)["figures"][key] for key in ("estimates", "estimates_deviation"))
    assert learned["load at tip m [kg]"] == pytest.approx(0.3, abs=0.03)
    found = nbs.AdaptiveLaw.for_robot(nbs.load_robot("two_link")).estimate(nbs.Run.load(folder / "run.npz"))
    assert list(off) == found.names
    np.testing.assert_allclose(list(off.values()), found.deviation, rtol=1e-9)
    assert f"the mass may be off by {found.deviation[0]:.2g} kg" in printed.replace("\n", " ")
    assert cli.main([*line, "--controller", "nbs", "--out", str(folder)]) == 2
    assert contents(folder).keys() == files
    printed = printed_by(*line, "--controller", "nbs", "--out", folder, "--force")
    assert "estimates" not in printed
    assert contents(folder).keys() == files - {"estimates.png"}


def test_several_laws_take_the_picture_away_too(tmp_path):
    line = ("track", "two_link", "--duration", "1", "--out", tmp_path, "--controller")
    printed_by(*line, "adaptive")
    assert "estimates.png" in contents(tmp_path)
    printed_by(*line, "nbs,adaptive", "--force")
    assert contents(tmp_path).keys() == {"run-nbs.npz", "run-adaptive.npz", "comparison.png", "summary.json"}
