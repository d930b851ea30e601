"""A plant that others replace during a run, and loads that appear in `nbs-pin track` and `nbs-pin run`."""

from fractions import Fraction

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.cli.payloads import read_payload_or_timed
from nbs_pin.reports import plotting
from nbs_pin.reports.captions import settings_in_words
from nbs_pin.reports.signals import signals_of
from nbs_pin.reports.verdicts import verdict_of
from nbs_pin.robots.carrying import carrying
from nbs_pin.robots.urdf_options import Payload
from nbs_pin.simulation.run_figures import changes_of, figures, loads_of
from tests.commands import printed_by, refusal, summary

BARE = nbs.load_robot("three_link")
LOADED = BARE.with_payload("", 0.5, (0.0, 0.0, 0.05))
LAW = nbs.NeuralBackstepping.for_robot(BARE)
MOTION = nbs.Sinusoid.for_robot(BARE)
PLANTS = {"mujoco": nbs.MujocoPlant, "pinocchio": nbs.DynamicsPlant.for_robot}


def changing(make, *times):
    """A plant whose load comes at the first time, goes at the second, and so on."""
    bare, loaded = make(BARE), make(LOADED)
    return nbs.ChangingPlant(bare, [(t, (loaded, bare)[k % 2]) for k, t in enumerate(times)])


@pytest.mark.parametrize("make", PLANTS.values(), ids=PLANTS)
def test_a_run_is_the_one_of_the_first_plant_and_then_that_of_the_next_from_where_it_left_the_arm(make):
    plant, duration, period, change = changing(make, 0.12), 0.3, 0.004, 30  # in periods
    run = nbs.simulate(plant, LAW, MOTION, duration, period)
    before = nbs.simulate(make(BARE), LAW, MOTION, change * period, period)
    after = nbs.simulate(
        make(LOADED), LAW, lambda t: MOTION(t + change * period), duration - change * period, period,
        q0=run.q[change], v0=run.v[change], effort_limit=BARE.effort_limit, check=False,
    )  # fmt: skip
    assert (run.q[: change + 1] == before.q).all()
    np.testing.assert_allclose(run.q[change:], after.q, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(run.v[change:], after.v, rtol=0.0, atol=1e-10)
    assert np.abs(run.q[-1] - MOTION(duration).q).max() > 1e-4
    assert np.abs(before.q - before.q_ref).max() < 1e-5


@pytest.mark.parametrize(("change", "step"), [(0.0085, 9), (0.009, 9), (0.0090001, 10), (0.0079999, 8), (0.012, 12)])
def test_a_change_between_control_instants_comes_with_the_first_plant_step_after_it(change, step):
    period, h = 0.004, 0.001
    run = nbs.simulate(changing(nbs.MujocoPlant, change), LAW, MOTION, 0.02, period)
    bare, loaded = nbs.MujocoPlant(BARE), nbs.MujocoPlant(LOADED)
    q, v = run.q[0], run.v[0]
    for k in range(20):
        q, v = (bare if k < step else loaded).step(q, v, run.tau[k // 4], h)
        if (k + 1) % 4 == 0:
            assert (q == run.q[(k + 1) // 4]).all()


@pytest.mark.parametrize("rate", [1000, 500, 300, 7, 1e5])
def test_rounding_neither_advances_nor_delays_a_change_on_a_plant_step(rate):
    """The exact rule is: k/rate ≥ the change; k/rate is computed in floats, in all ways of the time loops."""
    period = 1.0 / rate
    for k in np.random.default_rng(0).integers(1, 10**7, 300).tolist():
        change = float(Fraction(k) / Fraction(rate))
        plant = changing(lambda robot: nbs.DynamicsPlant.for_robot(robot), change)
        first, later = plant.at(0.0), plant.at(2.0 * change)
        for t, earlier in ((k * period, (k - 1) * period), (period * float(k), (k - 0.1) * period)):
            assert plant.at(t) is later is not first
            assert plant.at(earlier) is first
        assert plant.at((k - 1) * period + 4 * (period / 4)) is later
        assert plant.at(period * np.arange(k, k + 1.0)[0]) is later


def test_a_plant_that_stays_what_it_is_acts_at_all_times_and_a_change_to_itself_is_none():
    plant = nbs.MujocoPlant(BARE)
    assert plant.at(0.0) is plant is plant.at(1e6)
    assert plant.changes == ()
    same = nbs.ChangingPlant(plant, [(0.05, plant), (0.06, plant)])
    assert same.changes == (0.05, 0.06)
    one, other = (nbs.simulate(p, LAW, MOTION, 0.1, 0.001) for p in (plant, same))
    assert (one.q == other.q).all()
    assert (one.tau == other.tau).all()
    assert (same.nv, same.robot) == (3, BARE)
    q, v, tau = np.random.default_rng(1).normal(size=(3, 3))
    late = nbs.ChangingPlant(plant, [(1e-6, nbs.MujocoPlant(LOADED))])
    assert (np.array(late.step(q, v, tau, 1e-3)) == np.array(plant.step(q, v, tau, 1e-3))).all()


def test_at_rest_the_law_carries_the_weight_of_the_load_that_nobody_told_it_of():
    aim = nbs.Hold([0.4, -0.3, 0.5])
    run = nbs.simulate(changing(nbs.MujocoPlant, 2.0), LAW, aim, 8.0, 0.001)
    for robot, row in ((BARE, 1999), (LOADED, -2)):
        np.testing.assert_allclose(run.tau[row], nbs.PinocchioDynamics(robot).gravity(run.q[row]), atol=2e-3)
    assert np.abs(run.q[:2000] - aim.q).max() < 1e-9
    assert np.abs(run.q[-1] - aim.q).max() > 1e-3


def test_a_stream_and_workers_change_the_plant_at_the_same_times():
    plant = changing(nbs.MujocoPlant, 0.03, 0.05)
    run = nbs.simulate(plant, LAW, MOTION, 0.1, 0.001)
    blocks = list(nbs.stream(plant, LAW, MOTION, 0.1, 0.001, block=7))
    joined = np.concatenate([*(block.q[:-1] for block in blocks), blocks[-1].q[-1:]])
    assert (joined == run.q).all()
    assert run.info["plant_changes"] == [0.03, 0.05]
    starts = MOTION(0.0).q + np.random.default_rng(2).normal(scale=0.05, size=(3, 3))
    alone, shared = (nbs.simulate(plant, LAW, MOTION, 0.1, 0.001, q0=starts, workers=n) for n in (1, 2))
    assert (alone.q == shared.q).all()
    assert (nbs.simulate(plant, LAW, MOTION, 0.1, 0.001, q0=starts[1]).q == alone.q[:, 1]).all()


def test_a_simulated_arm_in_real_time_changes_with_its_own_clock():
    plant = changing(nbs.MujocoPlant, 0.01)
    arm, tau = nbs.PlantArm(plant, [0.3, 0.2, 0.1], real_time=False), np.array([5.0, 3.0, 1.0])
    q, v = np.array([0.3, 0.2, 0.1]), np.zeros(3)
    arm.start()
    arm.write(tau)
    for k in range(20):
        q, v = plant.at(0.0 if k < 10 else 1.0).step(q, v, tau, 0.001)
        sample = arm.read()
        assert (sample.q == q).all()
        assert (sample.v == v).all()


def test_a_plant_without_a_description_may_follow_one_with_it():
    learned = nbs.DynamicsPlant(nbs.AnalyticDynamics())
    plant = nbs.ChangingPlant(nbs.MujocoPlant(nbs.load_robot("two_link")), [(1.0, learned)])
    assert plant.at(1.0) is learned


BAD = {
    "changes[0][0] is 0; give a finite number > 0": lambda p: [(0, p)],
    "changes[0][0] is -1": lambda p: [(-1.0, p)],
    "changes[0][0] is nan": lambda p: [(np.nan, p)],
    "at 2 s and then at 1 s; give them in the order of time": lambda p: [(2.0, p), (1.0, p)],
    "at 2 s and then at 2 s": lambda p: [(2.0, p), (2.0, p)],
    "changes is []; give a list of 1 to 10000 changes": lambda p: [],
    "changes[0] is 3.0; give a pair of a time": lambda p: [3.0],
    "changes[0][1] is 'mujoco'; give a plant": lambda p: [(1.0, "mujoco")],
    "from 1 s on is of another arm: it has 2 joints and the first plant 3": lambda p: [
        (1.0, nbs.MujocoPlant(nbs.load_robot("two_link")))
    ],
    "from 1 s on is ChangingPlant(MujocoPlant(three_link, rk4, joint_friction=drop), changes at 1 s), which changes": (
        lambda p: [(1.0, nbs.ChangingPlant(p, [(1.0, p)]))]
    ),
}


@pytest.mark.parametrize("words", BAD)
def test_changes_that_make_no_sense_are_refused(words):
    plant = nbs.MujocoPlant(BARE)
    with pytest.raises(nbs.ArgumentError) as caught:
        nbs.ChangingPlant(plant, BAD[words](plant))
    assert words in str(caught.value)
    assert str(caught.value).startswith("ChangingPlant: ")


def test_joints_elsewhere_are_another_arm():
    six, other = (nbs.MujocoPlant(nbs.load_robot(name)) for name in ("ur5", "ur10"))
    with pytest.raises(nbs.ArgumentError, match=r"from 1 s on is of another arm: .*; build all for one arm"):
        nbs.ChangingPlant(six, [(1.0, other)])


def test_what_differentiates_the_plant_refuses_one_that_changes():
    plant = changing(nbs.DynamicsPlant.for_robot, 0.5)
    with pytest.raises(nbs.ArgumentError, match=r"ChangingPlant\(.*\) has no derivatives; train on DynamicsPlant"):
        nbs.train(LAW, plant, [MOTION], starts=1, duration=0.02, period=0.01, epochs=1)
    with pytest.raises(nbs.ArgumentError, match=r"ChangingPlant\.at: t is nan"):
        plant.at(np.nan)


def test_loads_add_up_with_those_that_the_arm_carries(tmp_path):
    """M and V are linear in what is carried, whichever link has it and by whatever name."""
    rng = np.random.default_rng(3)
    file = tmp_path / "mine.toml"
    file.write_text('description = "three_link"\n[payload.""]\nmass = 0.7\ncom = [0.01, 0.02, 0.03]\ninertia = 0.01\n')
    bare, own = nbs.load_robot("three_link"), nbs.load_robot(file)
    end = bare.frames[-1]
    for robot, links in ((own, ("", end, "", "link1")), (bare.with_payload(end, 2.0), ("", "link2", end))):
        loads = [(link, Payload(*rng.uniform(0.1, 2.0, 1), tuple(rng.normal(size=3)))) for link in links]
        held = nbs.PinocchioDynamics(carrying(robot, loads))
        q = rng.normal(size=(5, 3))
        mass, weight = (f(nbs.PinocchioDynamics(robot), q) for f in (_mass, _weight))
        for link, load in loads:
            alone = nbs.PinocchioDynamics(bare.with_payload(link, load.mass, load.com))
            mass = mass + _mass(alone, q) - _mass(nbs.PinocchioDynamics(bare), q)
            weight = weight + _weight(alone, q) - _weight(nbs.PinocchioDynamics(bare), q)
        np.testing.assert_allclose(_mass(held, q), mass, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(_weight(held, q), weight, rtol=1e-10, atol=1e-12)
        q, v, tau = rng.normal(size=(3, 3))
        moved = nbs.DynamicsPlant(nbs.PinocchioDynamics(carrying(robot, loads))).step(q, v, tau, 1e-3)
        in_mujoco = nbs.MujocoPlant(carrying(robot, loads)).step(q, v, tau, 1e-3)
        np.testing.assert_allclose(in_mujoco, moved, rtol=0.0, atol=1e-9)
    assert carrying(bare, []) is bare
    moon = nbs.load_robot("two_link", gravity=1.62)  # of the catalogue or given, it is not a matter of the load
    assert carrying(moon, [("", Payload(0.5, (0.0, 0.0, 0.0)))]).gravity_vector[2] == -1.62


def _mass(model, q):
    return model.mass_matrix(q)


def _weight(model, q):
    return model.gravity(q)


@pytest.mark.parametrize(("words", "found"), [
    ("2@5", ("", 2.0, (0.0, 0.0, 0.0), 5.0, None)),
    ("2@5-12", ("", 2.0, (0.0, 0.0, 0.0), 5.0, 12.0)),
    ("0.5@tip@.5", ("tip", 0.5, (0.0, 0.0, 0.0), 0.5, None)),
    ("0.5@tip:0,-1,0.1@1e-3-2e1", ("tip", 0.5, (0.0, -1.0, 0.1), 1e-3, 20.0)),
    ("2@5:0,0,1@7", ("5", 2.0, (0.0, 0.0, 1.0), 7.0, None)),
])  # fmt: skip
def test_a_load_with_times_is_read_as_typed(words, found):
    load = read_payload_or_timed(words)
    assert (load.link, load.mass, load.com, load.begin, load.end) == found


@pytest.mark.parametrize("words", ["2", "2@tip", "2@2f_gripper", "2@link_5", "2@5:0,0,0", "2@tip:1,2,3"])
def test_a_load_without_times_is_the_arms(words):
    assert read_payload_or_timed(words) is None


@pytest.mark.parametrize(("words", "said"), [
    ("2@-1", "above 0 s"), ("2@nan", "above 0 s"), ("2@inf", "above 0 s"), ("2@0", "above 0 s"), ("2@5-", "above 0 s"),
    ("2@5-5", "a later one"), ("2@5-4", "a later one"), ("2@5--4", "a later one"), ("@5", "give MASS [kg]"),
    ("2@5@6", "times once"), ("x@5", "give MASS [kg]"), ("-2@5", "give MASS [kg]"), ("2@tip:0,0@5", "give MASS [kg]"),
    ("2@20", "the motion ends at 10 s, before the load would appear"), ("2@10", "before the load would appear"),
    ("2@5-10", "before the load would go again"),
])  # fmt: skip
@pytest.mark.parametrize("command", ["track", "run"])
def test_times_that_make_no_sense_are_refused_by_the_option(command, words, said, capsys, tmp_path):
    line = refusal(cli.main([command, "three_link", f"--payload={words}", "--out", str(tmp_path / "out")]), capsys)
    assert line.startswith(f"nbs-pin: error: --payload is '{words}'")
    assert said in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", [
    "train three_link", "collect three_link", "learn data.npz", "compare model.nbs", "certify three_link",
    "export three_link", "replay run.npz", "robots three_link", "log data.csv", "excite three_link",
    "export-run run.npz",
])  # fmt: skip
def test_other_commands_say_that_they_do_not_simulate_a_load_that_appears(command, capsys):
    line = refusal(cli.main([*command.split(), "--payload=2@tip@5-12"]), capsys)
    assert "only nbs-pin track and nbs-pin run simulate; give --payload 2@tip for one that" in line


def test_every_command_with_an_arm_was_asked():
    arms = {name for name, kind in cli.COMMANDS.items() if "arm" in kind.__dataclass_fields__}
    asked = {"train", "collect", "learn", "compare", "certify", "export", "replay", "robots", "log", "excite"}
    assert arms == asked | {"export-run", "track", "run"}


@pytest.mark.parametrize("plant", PLANTS)
def test_track_shows_what_a_load_does_that_the_law_does_not_know(plant, tmp_path):
    loads = ("--payload", "0.1@link2", "--payload", "0.5@5", "--payload", "0.2@link2@7-8")
    printed = printed_by("track", "three_link", "--plant", plant, *loads, "--out", tmp_path)
    run, found = nbs.Run.load(tmp_path / "run.npz"), summary(tmp_path)
    error = np.linalg.norm(run.q - run.q_ref, axis=-1)
    assert error[: 5000 + 1].max() < 1e-6
    assert error[5100:].min() > 1e-3
    believed = BARE.with_payload("link2", 0.1)
    loaded = believed.with_payload("", 0.5)
    both = loaded.with_payload("link2", 0.1 + 0.2)
    make = PLANTS[plant]
    truth = nbs.ChangingPlant(make(believed), [(5.0, make(loaded)), (7.0, make(both)), (8.0, make(loaded))])
    law, motion = nbs.NeuralBackstepping.for_robot(believed), nbs.Sinusoid.for_robot(believed)
    np.testing.assert_allclose(nbs.simulate(truth, law, motion, 10.0, 0.001).q, run.q, rtol=0.0, atol=1e-9)
    assert run.robot_sha256 == believed.sha256
    said = "a load of 0.5 kg, unknown to the law, appeared at 5 s"
    gone = "a load of 0.2 kg at link2, unknown to the law, appeared at 7 s and was gone at 8 s"
    assert said in printed
    assert gone in printed
    assert {said, gone} <= set(verdict_of(found["figures"]).more)
    assert found["figures"]["loads"] == found["settings"]["loads"] == run.info["loads"]
    assert changes_of(run) == [5.0, 7.0, 8.0]
    assert any(f"in {'MuJoCo' if plant == 'mujoco' else 'Pinocchio'} (RK4)" in w for w in settings_in_words(run))


def test_the_settings_of_a_summary_make_the_run_again(tmp_path):
    once, again = tmp_path / "once", tmp_path / "again"
    typed = (
        "track",
        "three_link",
        "--duration",
        "0.4",
        "--controller",
        "pid",
        "--payload",
        "0.5@link2:0,0,0.1@0.1-0.3",
    )
    printed_by(*typed, "--out", once)
    settings = summary(once)["settings"]
    (load,) = settings["loads"]
    where = f"{load['link']}:{','.join(map(str, load['com_m']))}"
    words = f"{load['mass_kg']}@{where}@{load['from_s']}-{load['until_s']}"
    options = ("--duration", settings["duration"], "--controller", settings["controller"], "--payload", words)
    printed_by("track", settings["robot"], *options, "--out", again)
    assert (nbs.Run.load(once / "run.npz").q == nbs.Run.load(again / "run.npz").q).all()
    printed_by("track", "three_link", "--duration", "0.4", "--out", tmp_path / "bare")
    assert "loads" not in summary(tmp_path / "bare")["settings"]


def test_several_laws_meet_the_same_load_and_pictures_have_a_line_where_it_appears(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(plotting.Axes, "axvline", lambda axes, t, **_: drawn.append(t))
    options = ("--duration", "1", "--payload", "0.3@0.5", "--controller")
    printed = printed_by("track", "three_link", *options, "nbs,pd-plus", "--out", tmp_path / "two")
    assert "a load of 0.3 kg, unknown to the law, appeared at 0.5 s" in printed
    assert drawn == [0.5] * 2
    for law in ("nbs", "pd-plus"):
        run = nbs.Run.load(tmp_path / "two" / f"run-{law}.npz")
        assert loads_of(run)[0]["mass_kg"] == 0.3
        assert changes_of(run) == [0.5]
    printed_by("track", "three_link", *options, "nbs", "--out", tmp_path / "one")
    assert drawn == [0.5] * (2 + 9)
    alone = nbs.Run.load(tmp_path / "one" / "run.npz")
    assert (alone.q == nbs.Run.load(tmp_path / "two" / "run-nbs.npz").q).all()


def test_run_changes_the_simulated_arm_and_refuses_to_load_another(tmp_path, monkeypatch, capsys):
    from nbs_pin.commands import run as command

    def at_once(*given):
        arm = arm_at(*given)
        arm.real_time = False
        return arm

    arm_at = command.arm_at
    monkeypatch.setattr(command, "arm_at", at_once)
    printed = printed_by("run", "three_link", "--duration", "1", "--payload", "0.5@0.6", "--out", tmp_path)
    assert "a load of 0.5 kg, unknown to the law, appeared at 0.6 s" in printed
    run = nbs.Run.load(tmp_path / "run.npz")
    error = np.abs(run.q - run.q_ref).max(axis=-1)
    assert error[:601].max() < 1e-5
    assert error[700:].min() > 1e-4
    assert changes_of(run) == [0.6]
    line = refusal(cli.main(["run", "three_link", "--arm", "ur:nowhere", "--payload", "0.5@0.6"]), capsys)
    assert "'0.5@0.6', a load that appears in a simulated arm, but --arm is 'ur:nowhere'" in line


def test_a_load_that_never_came_is_not_told_and_notes_that_cannot_be_read_are_none():
    run = nbs.simulate(nbs.MujocoPlant(BARE), LAW, MOTION, 0.5, 0.001)
    load = {"mass_kg": 1.0, "link": "", "com_m": [0.0, 0.0, 0.0], "from_s": 0.2, "until_s": 0.6}
    run.info["loads"] = [load, load | {"from_s": 0.6, "until_s": None}]
    told = [text for text in verdict_of(figures(run)).more if "load" in text]
    assert told == ["a load of 1 kg, unknown to the law, appeared at 0.2 s"]
    stopped = verdict_of(figures(run) | {"stopped": {"time_s": 0.4, "why": "a fault"}})
    assert stopped.more == tuple(told)
    for noted in (None, 3, [3], [{}], [load | {"from_s": "x"}], [load | {"until_s": True}], [load | {"link": None}]):
        run.info["loads"] = noted
        assert loads_of(run) == []
        assert "loads" not in figures(run)
    for noted, times in ((None, []), (0.2, []), ([0.2, "x", None, True, 9.0], [0.2])):
        run.info["plant_changes"] = noted
        assert changes_of(run) == times


def test_charts_of_pages_mark_when_the_plant_changes():
    robot = nbs.load_robot("two_link")
    bare, loaded = (nbs.DynamicsPlant.for_robot(arm) for arm in (robot, robot.with_payload("tip", 0.5)))
    law, motion = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    for plant, times in ((nbs.ChangingPlant(bare, [(0.05, loaded), (0.1, bare)]), [0.05, 0.1]), (bare, [])):
        assert signals_of(nbs.simulate(plant, law, motion, 0.2, 0.001), robot)["changes"] == times
