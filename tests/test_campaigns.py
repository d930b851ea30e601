"""Campaigns: what a file may say, what a trial is, and one table whoever runs it and however often it is killed."""

import json
import os
import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.campaigns import trials
from nbs_pin.campaigns.campaign import MOST_TRIALS
from nbs_pin.campaigns.journal import JOURNAL
from nbs_pin.campaigns.trials import is_fused, run_of
from nbs_pin.reports.campaign_charts import plot_campaign
from nbs_pin.reports.verdicts import BAD, NOTE, WARNING, verdict_of
from tests.commands import contents, refusal, summary

TOML = """
robot = "two_link"
duration = 0.2
start_spread = 0.2
samples = 3
seed = 7

[grid]
law = ["nbs", "pid"]
disturbance = ["none", "sine:2@8"]

[random]
payload = { from = 0.0, to = 1.0 }
law_seed = { from = 0, to = 3 }
frequency = [0.5, 1.0]
"""


def campaign_in(folder, text=TOML):
    path = folder / "plan.toml"
    path.write_text(text)
    return nbs.Campaign.load(path)


def small(**given):
    return nbs.Campaign(**({"fixed": {"robot": "two_link", "duration": 0.1}} | given))


def test_a_file_becomes_every_combination_with_every_sample(tmp_path):
    campaign = campaign_in(tmp_path)
    assert repr(campaign) == "Campaign(12 trials, grid of law, disturbance, random payload, law_seed, frequency)"
    assert [trial.number for trial in campaign.trials] == list(range(12))
    assert [trial.sample for trial in campaign.trials] == [0] * 4 + [1] * 4 + [2] * 4
    first = campaign.trials[:4]
    assert {trial.values["payload"] for trial in first} == {first[0].values["payload"]}  # met by every law
    assert [(trial.values["law"], trial.values["disturbance"]) for trial in first] == [
        ("nbs", "none"), ("nbs", "sine:2@8"), ("pid", "none"), ("pid", "sine:2@8")
    ]  # fmt: skip
    assert all(0.0 <= trial.values["payload"] < 1.0 for trial in campaign.trials)
    assert campaign.trials[0].values["bandwidth"] == 8.0


def test_python_says_the_same_as_a_file(tmp_path):
    random_ = {"payload": {"from": 0, "to": 1}, "law_seed": {"from": 0, "to": 3}, "frequency": [0.5, 1.0]}
    fixed = {"robot": "two_link", "duration": 0.2, "start_spread": 0.2}
    grid = {"law": ["nbs", "pid"], "disturbance": ["none", "sine:2@8"]}
    ours = nbs.Campaign(fixed, grid=grid, random=random_, samples=3, seed=7)
    assert ours.plan == campaign_in(tmp_path).plan
    assert ours.trials == campaign_in(tmp_path).trials


def test_a_draw_depends_on_seed_sample_and_name_alone():
    one = small(random={"payload": {"from": 0.0, "to": 1.0}}, samples=4)
    more = small(
        random={"bandwidth": [4.0, 8.0], "payload": {"from": 0.0, "to": 1.0}}, samples=9, grid={"law": ["nbs", "pid"]}
    )
    drawn = [trial.values["payload"] for trial in one.trials]
    assert len(set(drawn)) == 4
    assert [trial.values["payload"] for trial in more.trials[::2]][:4] == drawn
    other = small(random={"payload": {"from": 0.0, "to": 1.0}}, samples=4, seed=1)
    assert not set(drawn) & {trial.values["payload"] for trial in other.trials}


def test_whole_numbers_are_drawn_with_both_ends():
    found = {trial.values["law_seed"] for trial in small(random={"law_seed": {"from": 2, "to": 4}}, samples=60).trials}
    assert found == {2, 3, 4}


def test_files_beside_the_campaign_are_found_there(tmp_path):
    law = nbs.PD.for_robot(nbs.load_robot("two_link"))
    nbs.save(law, tmp_path / "mine.nbs")
    campaign = campaign_in(tmp_path, 'robot = "two_link"\nduration = 0.1\n[grid]\nlaw = ["mine.nbs", "pid"]')
    assert campaign.trials[0].values["law"] == str(tmp_path / "mine.nbs")
    assert run_of(campaign.trials[0])[0].info["controller"] == "PD"


@pytest.mark.parametrize(("text", "words"), [
    ('robot = "panda"\nlaws = "nbs"', "plan.toml has 'laws'; did you mean law?"),
    ('robot = "panda"\n[grid]\npayloads = [1.0]', "plan.toml: grid has 'payloads'; did you mean payload?"),
    ('robot = "panda"\n[grid]\npayload = 1.0', "plan.toml: grid.payload is 1.0; give a list"),
    ('robot = "panda"\n[grid]\npayload = [1.0, "two"]', "plan.toml: grid.payload[1] is 'two'; give a finite number"),
    ('robot = "panda"\n[grid]\npayload = [1.0, 1.0]', "with one value twice"),
    ('robot = "panda"\n[grid]\nlaw = []', "grid.law is []; give a list"),
    ('robot = "panda"\nlaw = "nbx"', "plan.toml: law: law 'nbx' is unknown; did you mean nbs?"),
    ('robot = "panda"\ndisturbance = "sine:5"', "plan.toml: disturbance is 'sine:5'; give none, constant:5"),
    ('robot = "panda"\nduration = -1.0', "plan.toml: duration is -1.0; give a finite number > 0"),
    ('robot = "panda"\nfriction = "some"', "plan.toml: friction 'some' is unknown; give one of drop, keep"),
    ('robot = "panda"\nduration = 2026-01-01', "plan.toml: duration is a date"),
    ('robot = "panda"\nsamples = 2.5', "plan.toml: samples is 2.5; give a whole number"),
    ('robot = "panda"\nperiod = [0.001]', "plan.toml: period is [0.001]; give a finite number"),
    ('robot = "panda"\n[random]\nlaw = { from = 0, to = 1 }', "random.law is a dict of 2; give a list"),
    ('robot = "panda"\n[random]\npayload = { from = 0.0 }', "give both from and to"),
    ('robot = "panda"\n[random]\npayload = { from = 2.0, to = 1.0 }', "give the smaller one first"),
    ('robot = "panda"\n[random]\npayload = { low = 0.0, to = 1.0 }', "random.payload has 'low'"),
    ('robot = "panda"\n[random]\npayload = [1.0]\n[grid]\npayload = [2.0]', "payload is given twice"),
    ('law = "nbs"', "plan.toml: robot is missing"),
    ('robot = "panda"\ngrid = 3', "plan.toml: grid is 3; give a dictionary"),
    ('robot = "panda"\n[arm]\nlocks = ["a"]', "plan.toml: arm has 'locks'; did you mean lock?"),
    ('robot = "panda"\n[arm]\nlock = 2026-01-01', "plan.toml: arm.lock is a date"),
    ('robot = "panda"\n[grid', "cannot be read as TOML"),
    (f'robot = "panda"\nsamples = {MOST_TRIALS}\n[grid]\nlaw = ["nbs", "pid"]', "200000 trials are asked for"),
])  # fmt: skip
def test_what_a_file_may_not_say_is_refused_by_file_and_key(tmp_path, text, words):
    with pytest.raises(nbs.FileFormatError) as told:
        campaign_in(tmp_path, text)
    assert words in str(told.value)
    assert str(told.value).startswith(str(tmp_path / "plan.toml"))
    assert str(told.value).count(". ") <= 1


def test_python_is_refused_without_a_file():
    with pytest.raises(nbs.ArgumentError, match=r"^Campaign: grid has 'lawn'; did you mean law\?"):
        small(grid={"lawn": ["nbs"]})


def test_a_trial_is_the_run_of_simulate_on_the_arm_as_it_is():
    """Everything by hand: the load, what the law does not know of it, friction, limits and the disturbance."""
    fixed = {"robot": "two_link", "duration": 0.3, "payload": 0.7, "unknown_viscous": 0.2, "unknown_coulomb": 0.1,
             "effort_share": 0.4, "disturbance": "square:2@9", "start_error": 0.2, "bandwidth": 5.0}  # fmt: skip
    arm = {"limits": {"*": {"effort": 100.0}}}
    trial = nbs.Campaign(fixed, arm=arm).trials[0]
    run, robot = run_of(trial)
    assert is_fused(trial)
    known = nbs.load_robot("two_link", **arm)
    limited = known.with_effort_limit(40.0)
    np.testing.assert_array_equal(robot.effort_limit, limited.effort_limit)
    friction = nbs.JointFriction([0.2, 0.2], [0.1, 0.1])
    plant = nbs.DynamicsPlant(nbs.PinocchioDynamics(known.with_payload("", 0.7)), "rk4", friction)
    motion = nbs.Sinusoid.for_robot(known)
    law = nbs.NeuralBackstepping.for_robot(limited, bandwidth=5.0, period=0.001)
    simulated = nbs.simulate(
        plant, law, motion, 0.3, 0.001, q0=motion(0.0).q + np.array([0.2, -0.2]), effort_limit=40.0,
        disturbance=nbs.SquareWave(2.0, 9.0), check=False,
    )  # fmt: skip
    for name, values in simulated.signals.items():
        np.testing.assert_allclose(getattr(run, name), values, rtol=1e-9, atol=1e-9, err_msg=name)


def test_bodies_err_within_their_share_and_alike_for_every_law():
    campaign = small(
        fixed={"robot": "panda", "duration": 0.01, "inertia_error": 5.0}, grid={"law": ["nbs", "pid"]}, samples=2
    )
    nominal = nbs.load_robot("panda").model
    from nbs_pin.campaigns.trials import _plant

    models = [_plant(trial, ("panda", "{}")).dynamics.model for trial in campaign.trials]
    shares = np.array(
        [
            [body.mass / own.mass - 1.0 for body, own in zip(m.inertias, nominal.inertias, strict=True)][1:]
            for m in models
        ]
    )
    assert np.abs(shares).max() <= 0.05 + 1e-12
    assert np.abs(shares).max() > 0.02
    assert (shares[0] == shares[1]).all()
    assert not (shares[0] == shares[2]).any()
    for body, own in zip(list(models[0].inertias)[1:], list(nominal.inertias)[1:], strict=True):
        np.testing.assert_allclose(body.inertia / body.mass, own.inertia / own.mass, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("given", [{"law": "sliding-mode"}, {"plant": "mujoco"}, {"law": "adaptive"}])
def test_what_has_no_kernel_runs_too(tmp_path, given):
    campaign = small(fixed={"robot": "two_link", "duration": 0.05, **given})
    assert not is_fused(campaign.trials[0])
    figures = nbs.run_campaign(campaign, tmp_path).rows[0].figures
    assert figures.rms_error_rad < 1e-2


def test_a_trial_that_fails_is_a_row_with_its_reason(tmp_path):
    campaign = nbs.Campaign(
        {"duration": 0.1, "period": 0.01},
        grid={
            "robot": ["two_link", "nowhere.urdf"],
            "integrator": ["rk4", "implicitfast"],
            "disturbance": ["none", "constant:1e20"],
        },
    )
    table = nbs.run_campaign(campaign, tmp_path)
    assert [bool(row.figures) for row in table.rows] == [True] + [False] * 7
    for row, words in zip(table.rows[1:], ["diverged", *["implicitfast"] * 2, *["nowhere.urdf"] * 4], strict=True):
        assert words in row.failure
    assert table.failures == table.rows[1:]
    assert table.column("rms_error_rad")[1:] == [None] * 7
    assert table.worst(5) == table.rows[:1]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The campaign of TOML, run by one worker without a stop."""
    folder = tmp_path_factory.mktemp("whole")
    return nbs.run_campaign(campaign_in(folder), folder / "results")


def test_the_table_is_the_same_from_any_workers(tmp_path, whole):
    for workers in (2, 5):
        assert nbs.run_campaign(whole.campaign, tmp_path / str(workers), workers=workers).rows == whole.rows


def test_processes_give_the_same_table(tmp_path):
    campaign = small(
        fixed={"robot": "two_link", "duration": 0.05, "law": "sliding-mode"}, random={"payload": [0.0, 0.5]}, samples=3
    )
    one, two = (nbs.run_campaign(campaign, tmp_path / str(n), workers=n).rows for n in (1, 2))
    assert one == two


def test_a_cluster_gives_the_same_table(tmp_path, whole):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        found = nbs.run_campaign(whole.campaign, tmp_path, cluster=cluster.scheduler_address)
    assert found.rows == whole.rows


def test_a_changed_campaign_is_refused_by_what_changed(tmp_path):
    nbs.run_campaign(campaign_in(tmp_path), tmp_path / "results")
    with pytest.raises(nbs.ArgumentError, match=r"fixed\.duration 0.2 where it is now 0.1"):
        nbs.run_campaign(campaign_in(tmp_path, TOML.replace("0.2\n", "0.1\n", 1)), tmp_path / "results")
    nbs.run_campaign(campaign_in(tmp_path, f"keep_runs = 3\n{TOML}"), tmp_path / "results")  # which changes no result


def test_a_changed_file_is_refused_by_its_name(tmp_path):
    robot = nbs.load_robot("two_link")
    text = 'robot = "two_link"\nduration = 0.05\nlaw = "mine.nbs"'
    nbs.save(nbs.PD.for_robot(robot), tmp_path / "mine.nbs")
    nbs.run_campaign(campaign_in(tmp_path, text), tmp_path / "results")
    nbs.save(nbs.PD.for_robot(robot, feedforward="gravity"), tmp_path / "mine.nbs")
    with pytest.raises(nbs.ArgumentError, match=r"files\..*mine\.nbs"):
        nbs.run_campaign(campaign_in(tmp_path, text), tmp_path / "results")


def test_csv_and_parquet_hold_the_table(tmp_path, whole):
    lines = whole.write_csv(tmp_path / "table.csv").read_text().splitlines()
    assert tuple(lines[0].split(",")) == whole.columns
    cells = dict(zip(whole.columns, lines[6].split(","), strict=True))
    assert float(cells["rms_error_rad"]) == whole.rows[5].figures.rms_error_rad
    assert (cells["trial"], cells["sample"], cells["law"]) == ("5", "1", "nbs")
    parquet = pytest.importorskip("pyarrow.parquet")
    read = parquet.read_table(whole.write_parquet(tmp_path / "table.parquet")).to_pydict()
    assert read == {name: whole.column(name) for name in whole.columns}


def test_groups_are_what_varies_in_steps(whole):
    words = {name.rpartition(", ")[0] for name in whole.groups()}  # without the frequency, which is drawn from a list
    assert words == {"nbs, none", "nbs, sine:2@8", "pid, none", "pid, sine:2@8"}
    assert list(whole.groups(most=4)) == ["nbs, none", "nbs, sine:2@8", "pid, none", "pid, sine:2@8"]
    assert list(whole.groups(most=2)) == ["nbs", "pid"]
    assert list(whole.groups(most=1)) == ["all"]
    assert sum(map(len, whole.groups().values())) == 12


def test_verdict_and_picture_tell_failures(tmp_path, whole):
    assert verdict_of(whole.figures).level == NOTE
    some = nbs.run_campaign(small(fixed={"duration": 0.05}, grid={"robot": ["two_link", "nowhere"]}), tmp_path / "some")
    verdict = verdict_of(some.figures)
    assert (verdict.level, "; 1 failed" in verdict.said) == (WARNING, True)
    plot_campaign(some, tmp_path / "some.svg")
    assert "nowhere" in repr(some.groups())
    none = nbs.run_campaign(small(fixed={"robot": "nowhere"}), tmp_path / "none")
    assert verdict_of(none.figures) == (BAD, "all of 1 trial failed", ())


def test_a_killed_command_goes_on_to_the_same_table(tmp_path):
    """Twenty kills are in tools/campaign_kills.py."""
    text = 'robot = "two_link"\nduration = 0.5\nsamples = 120\n[random]\npayload = { from = 0.0, to = 1.0 }\n'
    (tmp_path / "plan.toml").write_text(text)
    command = [sys.executable, "-m", "nbs_pin.cli", "campaign", "plan.toml", "--workers", "2"]
    journal = tmp_path / "out" / "campaign-plan" / JOURNAL
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while process.poll() is None and (not journal.exists() or journal.read_bytes().count(b"\n") < 5):
            time.sleep(0.002)
        time.sleep(0.02 * random.random())
        os.kill(process.pid, signal.SIGKILL)
    assert 4 < journal.read_bytes().count(b"\n") < 120
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "over 120 trials" in done.stdout
    campaign = nbs.Campaign.load(tmp_path / "plan.toml")
    nbs.run_campaign(campaign, tmp_path / "alone").write_csv(tmp_path / "alone.csv")
    assert (journal.parent / "table.csv").read_text() == (tmp_path / "alone.csv").read_text()
    keys = [json.loads(line)["key"] for line in journal.read_text().splitlines()[1:]]
    assert sorted(keys, key=int) == [str(k) for k in range(120)]  # none twice


def test_the_command_writes_table_picture_worst_runs_and_summary(tmp_path, capsys):
    campaign_in(tmp_path, f"keep_runs = 2\n{TOML}")

    def run(folder, *more):
        return cli.main(["campaign", str(tmp_path / "plan.toml"), "--workers", "1", "--out", str(folder), *more])

    folder = tmp_path / "results"
    assert run(folder, "--parquet", "-v") == 0
    printed = capsys.readouterr().out
    worst = summary(folder)["figures"]["worst"]
    table = nbs.run_campaign(nbs.Campaign.load(tmp_path / "plan.toml"), folder)
    first, second = table.worst(2)
    assert (worst["trial"], worst["settings"]["payload"]) == (first.trial.number, first.trial.values["payload"])
    names = {"results.jsonl", "table.csv", "table.parquet", "errors.png", "summary.json", "run.npz"}
    assert set(contents(folder)) == names | {f"run-{second.trial.number}.npz"}
    assert f"trial {first.trial.number} (" in printed
    kept = nbs.Run.load(folder / "run.npz")
    assert nbs.metrics.rms_error(kept).max() == first.figures.rms_error_rad
    assert cli.main(["replay", str(folder), "--out", str(tmp_path / "replay.html")]) == 0
    capsys.readouterr()
    assert run(folder) == 0  # nothing is left to do
    assert "table.parquet" not in contents(folder)
    capsys.readouterr()
    (tmp_path / "plan.toml").write_text(TOML.replace("samples = 3", "samples = 1"))
    before = contents(folder)
    assert "with samples 3 where it is now 1; give another --out, or --force" in refusal(run(folder), capsys)
    assert contents(folder) == before
    assert run(folder, "--force") == 0
    assert len((folder / "table.csv").read_text().splitlines()) == 5
    assert f"run-{second.trial.number}.npz" not in contents(folder)


def test_the_command_keeps_what_ctrl_c_leaves(tmp_path, monkeypatch, capsys):
    campaign_in(tmp_path)
    folder, done = tmp_path / "results", []
    work = trials.figures_of

    def stopped(trial):
        done.append(trial.number)
        if trial.number == 5:
            raise KeyboardInterrupt
        return work(trial)

    monkeypatch.setattr("nbs_pin.campaigns.table.figures_of", stopped)
    arguments = ["campaign", str(tmp_path / "plan.toml"), "--workers", "1", "--out", str(folder)]
    assert cli.main(arguments) == 130
    assert "the same command goes on" in capsys.readouterr().err
    monkeypatch.undo()
    assert cli.main(arguments) == 0
    assert [json.loads(line)["key"] for line in (folder / JOURNAL).read_text().splitlines()[1:]] == [
        *map(str, range(12))
    ]


def test_results_of_another_command_stay(tmp_path, capsys):
    campaign_in(tmp_path)
    folder = tmp_path / "results"
    assert cli.main(["track", "two_link", "--duration", "0.1", "--out", str(folder)]) == 0
    capsys.readouterr()
    code = cli.main(["campaign", str(tmp_path / "plan.toml"), "--out", str(folder)])
    assert "another command" in refusal(code, capsys)
