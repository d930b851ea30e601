"""The campaign of the adaptive law: short rows, and the set that no update leaves."""

import importlib.util
import json
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin.kernels.symmetric4 import FARTHEST

TOOLS = Path(__file__).parent.parent / "tools"


@cache
def tool(name):
    spec = importlib.util.spec_from_file_location(name, TOOLS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def test_short_rows_of_the_campaign(tmp_path, monkeypatch, capsys):
    tool("adaptive_updates")
    path = tmp_path / "figures.json"
    rows = ["--rows", "cg", "--motions", "0", "--seconds", "0.4", "--arms", "two_link"]
    monkeypatch.setattr(sys, "argv", ["adaptive_campaign.py", *rows, "--out", str(path)])
    assert tool("adaptive_campaign").main() in (0, 1)
    found = json.loads(path.read_text())["figures"]
    assert {x["row"] for x in found} == {"c", "g"}
    assert all(np.isfinite(x["value"]) and x["value"] > 0.0 for x in found)
    assert "two_link" in capsys.readouterr().out


@pytest.mark.parametrize("adapts", [["load", "friction", "rotors"], ["links", "offsets"]], ids="+".join)
def test_no_update_leaves_the_set(adapts):
    law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(nbs.load_robot("two_link")), adapts)
    found = tool("adaptive_updates").updates(law, 10_000)
    assert (found.outside, found.beyond, found.not_finite) == (0, 0, 0)


def test_a_body_that_cannot_exist_is_seen():
    below_zero = tool("adaptive_updates").below_zero
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(4, 4)))
    for least, expected in ((-0.5, 0.25), (0.5, 0.0)):
        matrix = turn @ np.diag([1.0, 2.0, 3.0, least]) @ turn.T
        assert below_zero(matrix.ravel(), 2.0, np.empty(52)) == pytest.approx(expected, abs=1e-14)


@pytest.mark.parametrize("name", ["panda", "ur5"])
def test_a_constant_torque_is_integrated_away(name):
    """5 N·m that nobody told the law: the error vanishes, at rates that bear the delay of the update.

    Bounds of the whole effort limit make 5 N·m a small share of the interval, which takes some seconds to learn.
    """
    robot = nbs.load_robot(name)
    law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(robot), ["offsets"])
    hold = nbs.Hold(nbs.Sinusoid.for_robot(robot).offset)
    push = nbs.ConstantTorque(5.0)
    run = nbs.simulate(nbs.MujocoPlant(robot), law, hold, 7.0, 0.001, disturbance=push, check=False)
    assert np.abs(run.q - run.q_ref)[-500:].max() < 1e-8
    np.testing.assert_allclose(law.estimate(run.estimates[-1]).offset, -5.0, rtol=1e-6)
    assert np.abs(run.estimates).max() < FARTHEST  # no offset went to its bound, far above 5 N·m
