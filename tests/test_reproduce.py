"""`nbs-pin reproduce`: the paper's own program gives its digits, the page says what the files hold, the bounds hold."""

import csv
import json
import re

import numpy as np
import pytest
import torch

from nbs_pin.base.arrays import matvec
from nbs_pin.base.plain import plain
from nbs_pin.base.torch_threads import one_thread
from nbs_pin.cli import main
from nbs_pin.commands import reproduce
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.motions.references import paper_reference
from nbs_pin.reports.markdown import Section, page, short
from nbs_pin.reproduction import paper, paper_alpha
from nbs_pin.reproduction.authors import PERIOD, AuthorsLaw, follow_authors, train_authors
from nbs_pin.reproduction.paper_alpha import LARGEST_INERTIA, corrected_bound, regulariser, swept_controller
from nbs_pin.reproduction.paper_table import COLUMNS, PRINTED, Row
from nbs_pin.simulation import metrics
from tests.test_plotting import png_size

SMALL = paper.Scale(seeds=2, epochs=3, alphas=4, duration=5.0)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Folder and sections of a small reproduction; waves of half a minute reach as far as those of a whole one."""
    folder = tmp_path_factory.mktemp("reproduced")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper_alpha, "SQUARE_DURATION", 30.0)
        return folder, list(paper.reproduce_paper(folder, seed=0, scale=SMALL))


@pytest.fixture(scope="module", autouse=True)
def thread():
    with one_thread():
        yield


# The paper's program.


def test_seed_3_of_the_papers_program_gives_the_papers_digits():
    """Table I, rows 2 and 3."""
    law = AuthorsLaw([3])
    before = follow_authors(law, 100.0)
    train_authors(law)
    after = follow_authors(law, 2.0)
    assert metrics.steady_error(before, shift=1)[0] == pytest.approx(1.30e-6, abs=0.005e-6)
    assert metrics.steady_error(before)[0] < 0.1e-6
    times = [metrics.convergence_time(run, shift=1)[0] for run in (before, after)]
    assert times == pytest.approx([5.72, 0.13], abs=0.005)
    assert metrics.peak_torque(before)[0] < 50.0 < 800.0 < metrics.peak_torque(after)[0] < 1000.0


def unrolled_cost(law, torque):
    """The program's cost as a chain of torch operations, M, C and G held constant at every step."""
    dynamics, reference = AnalyticDynamics(), paper_reference(2)
    q = v = torch.zeros(len(law.weights["x0"]), 1, 2, dtype=torch.float64)
    cost = torch.zeros(())
    for k in range(100):
        desired = [torch.as_tensor(x) for x in reference(k * PERIOD)]
        tau = law.torques(q, v, *desired) + torch.as_tensor(torque)
        still_q, still_v = q.detach(), v.detach()
        bias = matvec(dynamics.coriolis_matrix(still_q, still_v), still_v) + dynamics.gravity(still_q)
        acceleration = torch.linalg.solve(dynamics.mass_matrix(still_q), tau - bias)
        q, v = q + PERIOD * v, v + PERIOD * acceleration
        cost = cost + ((q - desired[0]) ** 2).sum()
    return cost


def test_the_programs_gradient_is_that_of_its_chain_of_operations():
    law, twin = AuthorsLaw([0, 5], m=0.3), AuthorsLaw([0, 5], m=0.3)
    train_authors(law, epochs=1, torque=[1.0, 1.0])
    unrolled_cost(twin, [1.0, 1.0]).backward()
    for name, weight in law.weights.items():
        assert torch.allclose(weight.grad, twin.weights[name].grad, rtol=1e-8, atol=1e-10), name
    assert law.weights["x1"].grad.abs().max() > 1e-3


def test_seeds_side_by_side_are_each_alone():
    both, alone = AuthorsLaw([1, 2]), AuthorsLaw([2])
    for law in (both, alone):
        train_authors(law, epochs=3)
    np.testing.assert_allclose(follow_authors(both, 2.0).q[:, 1], follow_authors(alone, 2.0).q[:, 0], atol=1e-12)


def test_a_seed_that_is_lost_leaves_the_others_alone():
    lost, whole = AuthorsLaw([0, 1]), AuthorsLaw([1])
    with torch.no_grad():
        lost.weights["x0"][0] = np.inf
    run = follow_authors(lost, 1.0)
    assert metrics.convergence_time(run)[0] == metrics.steady_error(run)[0] == np.inf
    np.testing.assert_allclose(run.q[:, 1], follow_authors(whole, 1.0).q[:, 0], atol=1e-12)


# The bounds.


def test_the_largest_inertia_is_the_arms():
    q = np.stack([np.zeros(721), np.linspace(-np.pi, np.pi, 721)], axis=-1)
    values = np.linalg.eigvalsh(AnalyticDynamics().mass_matrix(q))
    assert pytest.approx(values.max(), rel=1e-12) == LARGEST_INERTIA


@pytest.mark.parametrize("alpha", [0.01, 0.05, 1.0, 2.0, 10.0])
def test_the_corrected_bound_takes_the_best_epsilon(alpha):
    epsilon = np.linspace(0.001, 1.999, 4001)
    limit = 4.0 / (2.0 * epsilon * np.minimum(2.0 * alpha, (2.0 - epsilon) * 0.5 / LARGEST_INERTIA))
    every = 2.0 * limit / alpha
    assert corrected_bound(alpha) <= every.min() * (1.0 + 1e-12)
    assert corrected_bound(alpha) == pytest.approx(every.min(), rel=1e-3)


def test_the_regulariser_is_what_is_missing_of_the_hessian():
    law = swept_controller(1.0, seed=0)  # ∇²Φ(0) = I: nothing of ψ bends at zero
    assert regulariser(law, 0.9).item() == 0.0
    assert regulariser(law, 1.5).item() == pytest.approx(0.5)


def test_as_printed_nothing_is_swept(small):
    _, sections = small
    flat = sections[2].figures["alpha"]["as_printed"]
    assert flat["regulariser"] == [0.0] * SMALL.alphas
    assert flat["weights_differ"] == 0.0
    assert flat["steady_error"][0] == flat["steady_error"][1]


def test_the_corrected_bound_is_above_everything_found(small):
    _, sections = small
    found = {k: np.array(v) for k, v in sections[2].figures["alpha"].items() if isinstance(v, list) and len(v) == 4}
    np.testing.assert_allclose(found["alpha"], [0.5, 1.0, 1.5, 2.0])
    for name in ("untrained", "trained", "square_untrained", "square_trained"):
        assert (found[name] > 0.0).all()
        assert (found[name] < found["corrected"]).all()
    np.testing.assert_allclose(found["printed"], 1.0 / found["alpha"] ** 2)
    assert (found["square_trained"] > found["trained"]).all()


# The page and its files.


def test_every_row_is_on_the_page_with_the_numbers_of_the_files(small):
    folder, sections = small
    assert sorted(path.name for path in folder.iterdir()) == sorted(paper.FILES)
    text, rows = sections[0].markdown, sections[0].figures["table1"]
    assert {row["row"] for row in rows} == set(PRINTED)
    assert len(rows) == 9
    with (folder / "table1.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    _, _, *table = [x.split(" | ") for x in text.splitlines() if x.startswith("| ") and not x.startswith("| **")]
    for row, cells in zip(rows, table, strict=True):
        own = [line for line in lines if (line["row"], line["how"]) == (row["row"], row["how"])]
        assert [int(line["seed"]) for line in own if line["seed"]] == row["seeds"]
        assert cells[0] == f"| {row['how']}"
        for name, cell in zip(COLUMNS, cells[1:], strict=False):
            values = [float(x[name]) for x in own]
            assert plain(values) == row[name]["values"]
            printed = [float("inf" if x == "∞" else x) for x in cell.replace("*", "").split(" – ")]
            expected = values if len(values) == 1 else [min(values), np.median(values), max(values)]
            assert printed == pytest.approx(expected, rel=6e-3, abs=5e-3 if name.endswith("_s") else 0.0)


def test_the_pictures_are_there_and_named(small):
    folder, sections = small
    text = page("Title", "Lead.", sections)
    assert text.startswith("# Title\n\nLead.\n\n## Table I\n")
    for name in re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text):
        assert min(png_size(folder / name)) > 400
    assert set(re.findall(r"\(([a-z]+\.png)\)", text)) == {n for n in paper.FILES if n.endswith(".png")}
    json.dumps([section.figures for section in sections], allow_nan=False)


def test_a_row_holds_a_number_within_its_spread_only():
    name = next(iter(COLUMNS))
    row = Row("PID", "some way", (0, 1), {name: np.array([1.0, 2.0])})
    assert [row.holds(name, x) for x in (0.99, 0.997, 1.5, 2.007, 2.02)] == [False, True, True, True, False]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"), (1.3e-6, "1.30e-6"), (0.01, "0.01"), (0.1, "0.1"), (0.13, "0.13"), (0.9951, "0.995"),
        (0.9996, "1.00"), (5.716, "5.72"), (9.996, "10.0"), (29.44, "29.4"), (892.63, "893"), (12345.0, "1.23e4"),
        (np.inf, "∞"),
    ],
)  # fmt: skip
def test_numbers_are_short(value, text):
    assert short(value) == text


# The command.


@pytest.fixture
def quick(monkeypatch):
    """A part that is done at once, in place of the paper's."""

    def part(folder, seed, progress):
        (folder / "part.csv").write_text("x\n")
        return [Section("First", f"Seed {seed}.", {"seed": seed})]

    monkeypatch.setitem(reproduce.PARTS, "paper", part)


def test_the_command_joins_the_parts(tmp_path, quick, capsys):
    folder = tmp_path / "new" / "out"
    assert main(["reproduce", "--part", "paper", "--seed", "7", "--out", str(folder)]) == 0
    assert "## First\n\nSeed 7." in (folder / "report.md").read_text()
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["figures"] == {"seed": 7}
    assert summary["settings"] == {"part": "paper", "quick": False, "seed": 7}
    assert "report.md" in capsys.readouterr().out
    assert main(["reproduce", "--part", "paper", "--seed", "7", "--out", str(folder)]) == 0
    assert main(["reproduce", "--part", "paper", "--seed", "8", "--out", str(folder)]) == 2
    assert "another run" in capsys.readouterr().err
    assert main(["reproduce", "--part", "paper", "--seed", "8", "--out", str(folder), "--force"]) == 0


def test_an_interrupted_command_leaves_no_empty_folder(tmp_path, monkeypatch, capsys):
    def part(folder, seed, progress):
        raise KeyboardInterrupt

    monkeypatch.setitem(reproduce.PARTS, "paper", part)
    assert main(["reproduce", "--part", "paper", "--out", str(tmp_path / "out")]) == 130
    assert not (tmp_path / "out").exists()
    assert "interrupted" in capsys.readouterr().err


def test_bad_options_are_refused_in_one_sentence(tmp_path, capsys):
    file = tmp_path / "file"
    file.touch()
    for words in (["--part", "nothing"], ["--seed", "-1"], ["--out", str(file)]):
        assert main(["reproduce", *words]) == 2
        assert capsys.readouterr().err.count("\n") == 1
