"""Files that earlier versions wrote load and give the numbers they gave; `tests/data/old` was written on 2026-11-22."""

from pathlib import Path

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin.base.records import Reference
from nbs_pin.controllers.controller import Controller

OLD = Path(__file__).parent / "data" / "old"
EXPECTED = dict(np.load(OLD / "expected.npz"))
STATES = EXPECTED.pop("states")


def torques(law: Controller) -> np.ndarray:
    found = []
    for q, v, *reference in STATES.swapaxes(0, 1):
        found.append(law.step(law.initial_memory(q), q, v, Reference(*reference), 0.001)[0])
    return np.array(found)


@pytest.mark.parametrize("name", [key.removeprefix("law ") for key in EXPECTED if key.startswith("law ")])
def test_a_controller_gives_its_torques(name):
    law = nbs.load(OLD / f"{name}.nbs")
    for form in (law, law.compile()):
        np.testing.assert_allclose(torques(form), EXPECTED[f"law {name}"], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("form", ["smooth", "paper"])
def test_a_seed_gives_the_networks_it_gave(form):
    old = nbs.load(OLD / ("nbs.nbs" if form == "smooth" else "nbs-paper.nbs"))
    new = nbs.NeuralBackstepping.for_robot(
        nbs.load_robot("two_link"), potential=form, damping="bounded" if form == "smooth" else "paper", seed=3
    )
    for name, weights in old.named_parameters():
        if ".w" in name:
            assert weights.equal(new.get_parameter(name)), name


@pytest.mark.parametrize("name", [key.removeprefix("model ") for key in EXPECTED if key.startswith("model ")])
def test_a_model_gives_its_torques_and_inertias(name):
    model, (q, v, w, a, _) = nbs.load(OLD / f"{name}.nbs"), STATES
    np.testing.assert_allclose(model.reference_torque(q, v, w, a), EXPECTED[f"model {name}"], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(model.mass_matrix(q), EXPECTED[f"mass {name}"], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("load", "prefix"), [(nbs.load_dataset, "data"), (nbs.Run.load, "run")])
def test_data_and_runs_hold_their_numbers(load, prefix):
    record = load(OLD / f"{prefix}.npz")
    for key in (key for key in EXPECTED if key.startswith(f"{prefix} ") and key != "run error"):
        np.testing.assert_array_equal(getattr(record, key.removeprefix(f"{prefix} ")), EXPECTED[key])


def test_a_run_has_its_error_and_can_be_replayed(tmp_path):
    run = nbs.Run.load(OLD / "run.npz")
    np.testing.assert_allclose(nbs.metrics.rms_error(run), EXPECTED["run error"], rtol=1e-12)
    assert nbs.replay(run, tmp_path / "replay.html").is_file()
