"""Pictures of every kind can be read: no text lies on another, and limits are those of the arm's file."""

import warnings
from types import SimpleNamespace

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin.certificates.attack import attack
from nbs_pin.commands.collect import plot_coverage
from nbs_pin.commands.excite import plot_excitation
from nbs_pin.reports.certificate_charts import plot_certificate, plot_monitor
from nbs_pin.reports.plotting import LIMIT, Heading, plot_tracking
from tests.overprinted import overprinted
from tests.test_plotting import drawn, sinusoid_run

LONG = "my_company_arm_with_a_long_name_v2_calibrated.urdf"
JOINT = "left_arm_shoulder_pan_joint_of_the_second_robot"


@pytest.fixture(scope="module")
def ur5():
    return nbs.load_robot("ur5")


@pytest.fixture(scope="module")
def certified():
    """A law, its bounds from a start beside the motion, and a motion beside them."""
    robot = nbs.load_robot("two_link")
    law, motion = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    certificate = nbs.certify(law, 1.0, reference=motion, q0=motion(0.0).q + 0.02)
    return certificate, attack(law, 1.0, duration=0.05, rounds=1, starts=1)


def test_the_heading_of_a_run_leaves_the_legend_and_the_names_of_joints_free(tmp_path, monkeypatch):
    told = {"controller": "NeuralBackstepping", "settings": {"seed": 0, "arm": {"armature": "0.1,0.2,0.3"}}}
    run = sinusoid_run(3, robot=LONG, names=(JOINT, "b", "c"), info=told | {"plant_changes": [1.0]})
    run.disturbance[:] = 0.3
    external = SimpleNamespace(torque=0.1 + 0.0 * run.q)
    figure = drawn(lambda: plot_tracking.__wrapped__(run, tmp_path / "a.png", external=external), monkeypatch)
    assert overprinted(figure) == []


def test_titles_of_certificates_leave_their_legends_free(certified, tmp_path, monkeypatch):
    certificate, found = certified
    for beside in (None, found):
        figure = drawn(lambda beside=beside: plot_certificate(certificate, beside, tmp_path / "a.png"), monkeypatch)
        assert overprinted(figure) == []
        shown = [text.get_text() for text in figure.axes[-1].get_legend().get_texts()]
        assert ("worst found" in shown) == (beside is not None)
    seen = nbs.monitor(found.run, certificate)
    assert overprinted(drawn(lambda: plot_monitor(seen, tmp_path / "a.png"), monkeypatch)) == []


def test_limits_in_the_picture_of_an_exciting_motion_are_those_of_the_file(ur5, tmp_path, monkeypatch):
    """Of a joint that turns twice, too, and of one without limits none are drawn."""
    motion = nbs.exciting_motion(ur5, duration=4.0, starts=1, clearance=None)
    free = ur5.with_effort_limit(np.where(np.arange(6) == 1, np.inf, ur5.effort_limit))
    heading = Heading("ur5: exciting motion", ["seed 0"])
    figure = drawn(lambda: plot_excitation(motion, tmp_path / "a.png", free, heading), monkeypatch)
    assert overprinted(figure) == []
    for joint, (position, velocity, torque) in enumerate(np.reshape(figure.axes, (6, 3))):
        of = free.joints[joint]
        assert limits_in(position) == [of.lower, of.upper]
        assert limits_in(velocity) == [-of.velocity, of.velocity]
        assert limits_in(torque) == [x for x in [of.effort] if np.isfinite(x)]
    assert max(ur5.upper) > 6.0


def test_names_of_joints_leave_the_shares_of_their_ranges_free(ur5, tmp_path, monkeypatch):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        data = nbs.collect(ur5, "excited", 200)
    free = ur5.with_effort_limit(np.where(np.arange(6) == 1, np.inf, ur5.effort_limit))
    figure = drawn(lambda: plot_coverage(data, tmp_path / "a.png", free), monkeypatch)
    assert overprinted(figure) == []
    told = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert "no limit" in told
    assert not any("inf" in text for text in told)


def limits_in(axes):
    """Where the lines of limits stand, from below."""
    return [line.get_ydata()[0] for line in axes.lines if line.get_color() == LIMIT]
