"""Certificate files: what certify writes is verified again, and whatever is better than proved is refused."""

import contextlib
import copy
import importlib
import json
import sys
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.exceptions import FileFormatError, MissingExtra
from nbs_pin.base.rounding import down
from nbs_pin.certificates.certificate_file import certificate_document, seal, write_certificate
from nbs_pin.certificates.comparison_system import decay, level, polygon, reach
from nbs_pin.controllers.registry import build_law
from nbs_pin.dynamics.rigid_tree import RigidTree
from nbs_pin.inertia import multipliers
from nbs_pin.robots.catalogue import find
from nbs_pin.verification import verify as checker
from nbs_pin.verification.balls import arb, balls, ctx, positive_definite
from nbs_pin.verification.document import read_document
from nbs_pin.verification.stated import FALSE, OPEN, TAKEN, VERIFIED
from nbs_pin.verification.trees import differences, stated_tree, urdf_tree
from nbs_pin.verification.verify import energy_form, verify
from tests.test_certificates import CONSTANTS
from tests.test_certify_cli import GANTRY


def certified(name, law="nbs", *, disturbance=2.0, fed=None, **task):
    robot = nbs.load_robot(name)
    controller = build_law(law, robot, bandwidth=8.0, period=0.001, seed=0, friction=fed)
    return nbs.certify(controller, np.full(robot.nv, disturbance), **task)


def written(document, path):
    """The document in a file, sealed as if it had been written so."""
    path.write_text(json.dumps({**document, "sha256": seal(document)}))
    return path


def statuses(found, *wanted):
    return [check.name for check in found.checks if check.status in wanted]


@pytest.fixture(scope="module")
def rubbing():
    """A certificate in which every constant is at work: ζ = 0, a start, friction that is fed forward in part."""
    robot = nbs.load_robot("two_link")
    fed = nbs.JointFriction(np.array([0.2, 0.1]), np.array([0.4, 0.1]))
    arm = nbs.JointFriction(np.array([0.3, 0.2]), np.array([0.5, 0.2]))
    smooth = nbs.Sinusoid.for_robot(robot)
    reference = lambda t: smooth(t)  # noqa: E731 - without a bound of its jerk nothing is proved of held torques
    start = reference(0.0).q + 0.02
    law = build_law("slotine-li", robot, bandwidth=8.0, period=0.001, seed=0, friction=fed)
    return certificate_document(
        nbs.certify(law, [2.0, 1.0], reference=reference, period=0.001, q0=start, friction=arm, robot=robot)
    )


@pytest.fixture(scope="module")
def panda():
    return certificate_document(certified("panda"))


@pytest.fixture(scope="module")
def gantry():
    return certificate_document(certified(GANTRY))


@pytest.fixture(scope="module")
def slider(tmp_path_factory):
    """A joint that slides behind one that turns."""
    path = tmp_path_factory.mktemp("slider") / "slider.urdf"
    path.write_text(random_urdf(np.random.default_rng(3), "rpr"))
    return certificate_document(certified(path, disturbance=0.5))


@pytest.fixture(scope="module")
def constant():
    """A law with ω = 0, which needs κ and a polygon far below the level."""
    robot = nbs.load_robot("panda")
    law = nbs.NeuralBackstepping(
        nbs.PinocchioDynamics(robot),
        nbs.Potential(np.diag(np.full(7, 4.0))),
        nbs.Damping(7, floor=np.diag(np.full(7, 4.0))),
        inertial_rate=0.0,
    )
    return certificate_document(nbs.certify(law, np.full(7, 5.0)))


DOCUMENTS = ("rubbing", "panda", "gantry", "slider", "constant")


# What was proved is verified


@pytest.mark.parametrize("name", ["two_link", "three_link", "ur5", "panda", GANTRY], ids=str)
@pytest.mark.parametrize("law", ["nbs", "slotine-li"])
def test_what_certify_proves_is_verified(name, law, tmp_path):
    bound = certified(name, law, disturbance=0.5)
    path = write_certificate(bound, tmp_path / "folder" / "certificate.json")
    found, document = verify(path), json.loads(path.read_text())
    assert found.confirmed, statuses(found, FALSE, OPEN)
    assert found.label == bound.label == "PROVED"
    assert document["bounds"]["error"] == bound.error
    assert document["bounds"]["joint_errors"] == bound.joint_errors.tolist()
    assert document["level"]["storage"] == bound.storage
    assert [document["constants"][key] for key in ("rho", "delta", "kappa", "nu")] == [
        getattr(bound.constants, key) for key in ("rho", "delta", "kappa", "nu")
    ]
    assert path.with_name("certificate.json").parent.joinpath("certificate.json").is_file()
    assert len(list(path.parent.iterdir())) == 1


@pytest.mark.parametrize("fixture", DOCUMENTS)
def test_each_document_of_these_tests_is_verified(fixture, request, tmp_path):
    document = request.getfixturevalue(fixture)
    assert verify(written(document, tmp_path / "c.json")).confirmed


def test_every_constant_is_at_work(rubbing, constant):
    k = rubbing["constants"]
    assert all(k[key] > 0.0 for key in ("rho", "delta", "kappa", "nu", "t", "alpha", "power"))
    assert rubbing["start"]["error"] > rubbing["bounds"]["error"]
    assert constant["bounds"]["potential"] < 0.2 * constant["level"]["storage"]
    assert constant["law"]["omega"] == 0.0


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_random_arms_are_read_and_verified_again(seed, tmp_path_factory):
    rng = np.random.default_rng(seed)
    path = tmp_path_factory.mktemp("arm") / "arm.urdf"
    path.write_text(random_urdf(rng))
    robot = nbs.load_robot(path)
    law = nbs.NeuralBackstepping.for_robot(robot)
    bound = nbs.certify(law, rng.uniform(0.1, 1.0, robot.nv), friction=nbs.JointFriction(*np.zeros((2, robot.nv))))
    found = verify(write_certificate(bound, path.with_name("c.json")))
    if robot.nv == 1:
        assert statuses(found, FALSE, OPEN) == ["‖z1‖ of one joint"]
    else:
        assert found.confirmed, (statuses(found, FALSE, OPEN), bound.void)


def random_urdf(rng, kinds=None):
    """An arm whose links are turned, offset and joined by fixed joints, in an order that is not that of the chain."""
    kinds = "".join(rng.choice(["r", "r", "p"], rng.integers(1, 5))) if kinds is None else kinds
    count = len(kinds)
    links, parts = ["<link name='base'/>"], []

    def words(x):
        return " ".join(f"{value:.6f}" for value in x)

    for i in range(count):
        parent, kind = "base" if i == 0 else f"tool{i - 1}", "prismatic" if kinds[i] == "p" else "revolute"
        for name in (f"link{i}", f"tool{i}"):
            mass, size = rng.uniform(0.5, 3.0), rng.uniform(0.05, 0.3, 3) ** 2
            xx, yy, zz = (mass / 12.0 * (size.sum() - x) for x in size)
            links.append(
                f"<link name='{name}'><inertial><origin xyz='{words(rng.uniform(-0.2, 0.2, 3))}' "
                f"rpy='{words(rng.uniform(-3, 3, 3))}'/><mass value='{mass:.6f}'/>"
                f"<inertia ixx='{xx:.8f}' iyy='{yy:.8f}' izz='{zz:.8f}' ixy='0' ixz='0' iyz='0'/></inertial></link>"
            )
        places = [
            f"<origin xyz='{words(rng.uniform(-0.4, 0.4, 3))}' rpy='{words(rng.uniform(-3, 3, 3))}'/>" for _ in "ab"
        ]
        axis = rng.normal(size=3)
        axis = np.eye(3)[rng.integers(3)] if rng.random() < 0.5 else axis / np.linalg.norm(axis)
        parts.append(
            f"<joint name='j{count - i}' type='{kind}'>{places[0]}<parent link='{parent}'/><child link='link{i}'/>"
            f"<axis xyz='{' '.join(map(repr, axis.tolist()))}'/>"
            "<limit lower='-0.4' upper='0.7' effort='900' velocity='9'/></joint>"
        )
        parts.append(
            f"<joint name='f{i}' type='fixed'>{places[1]}<parent link='link{i}'/><child link='tool{i}'/></joint>"
        )
    return f"<robot name='random'>{''.join(links)}{''.join(rng.permutation(parts))}</robot>"


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_forms_of_the_checker_are_those_of_every_motion(seed, tmp_path_factory):
    """xᵀFx is 2T − q̇ᵀWq̇ for all multipliers of turning joints, in the coordinates of any motion of Pinocchio's arm."""
    import pinocchio as pin

    rng = np.random.default_rng(seed)
    path = tmp_path_factory.mktemp("arm") / "arm.urdf"
    path.write_text(random_urdf(rng, "".join(rng.choice(["r", "r", "p"], 4))))
    robot = nbs.load_robot(path)
    tree, n = RigidTree.of(robot), robot.nv
    document = certificate_document(nbs.certify(nbs.NeuralBackstepping.for_robot(robot), 1.0))
    q, v = rng.uniform(np.maximum(robot.lower, -3), np.minimum(robot.upper, 3)), rng.normal(size=n)
    x, twists, alone = [], [], []
    for i, p in enumerate(tree.parents.tolist()):
        rotation, position = (part[0] for part in tree.placed(i, q[i : i + 1]))
        before = twists[p] if p >= 0 else np.zeros(6)
        own = np.concatenate([rotation.T @ (before[:3] + np.cross(before[3:], position)), rotation.T @ before[3:]])
        own[2 if tree.prismatic[i] else 5] += v[i]
        twists.append(own)
        alone.append(bool(tree.absent[i]))
        across = [0, 1] if tree.prismatic[i] else [0, 1, 3, 4]
        x += [*(own[across] if not alone[-1] else []), v[i]]
    mass = pin.crba(robot.model, robot.model.createData(), q)
    mass = np.triu(mass) + np.triu(mass, 1).T
    links = stated_tree(document["arm"]["joints"])
    h = [
        float(rng.normal())
        for link, skip in zip(links, alone, strict=True)
        if not skip
        for _ in range(1 if link.slides else 4)
    ]
    whole = [link._replace(travel=None) for link in links]  # without ends, every condition is an equation
    for sign in (1, -1):
        form = energy_form(whole, balls(np.diag(np.arange(1.0, n + 1))), sign, h)
        value = float((np.array(x) @ form @ np.array(x)).mid())
        expected = sign * (v @ mass @ v - v @ (np.arange(1.0, n + 1) * v))
        size = (
            np.abs(np.array(x)) @ np.array([[abs(float(y.mid())) for y in row] for row in form]) @ np.abs(np.array(x))
        )
        assert abs(value - expected) <= 1e-11 * (size + abs(expected))
    assert energy_form(whole, balls(np.eye(n)), 1, [*h, 1.0]) is None
    assert not h or energy_form(whole, balls(np.eye(n)), 1, h[:-1]) is None


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), size=st.integers(1, 8), shift=st.sampled_from([1e-30, 1e-12, 1.0]))
def test_a_matrix_is_positive_definite_in_balls_only_if_it_is(seed, size, shift):
    """A singular matrix A, of whole numbers, is not; A + εI is, however small ε, and A − εI is not."""
    rng = np.random.default_rng(seed)
    half = rng.integers(-9, 10, (size, max(size - 1, 1)))
    singular = half @ half.T if size > 1 else np.zeros((1, 1), dtype=int)
    with ctx.workprec(192):
        matrix, little = balls(singular.tolist()), balls(np.diag(np.full(size, shift)))
        assert not positive_definite(matrix)
        assert positive_definite(matrix + little)
        assert not positive_definite(matrix - little)


@settings(max_examples=15, deadline=None)
@given(k=CONSTANTS)
def test_levels_and_polygons_of_any_constants_are_verified_and_less_is_refused(k):
    found = level(k)
    if not np.isfinite(found.storage):
        return
    cut, potential = polygon(k, found.storage), reach(k, found.storage)
    document = {
        "constants": {key: getattr(k, key) for key in ("rho", "delta", "kappa", "t", "alpha", "beta", "power")},
        "law": {"omega": k.omega, "coupling": k.coupling},
        "level": {"c": found.c, "storage": found.storage, "rate": down(0.5 * decay(k))},
        "bounds": {"potential": potential},
        "polygon": None if cut is None else cut._asdict(),
    }
    document["constants"]["nu"] = k.nu if np.isfinite(k.nu) else None
    for change, names in (((), []), (("level", "storage"), ["c and V∞"]), (("bounds", "potential"), ["Φ∞"])):
        new = changed(document, change, lambda x: 0.98 * x) if change else document
        with ctx.workprec(192):
            false = [check.name for check in checker._levels(new) if check.status == FALSE]
        assert set(names) <= set(false)
        assert names or not false


@settings(max_examples=80, deadline=None)
@given(k=CONSTANTS, seed=st.integers(0, 10_000))
def test_no_choice_grows_on_an_edge_that_is_accepted(k, seed):
    """(3) of docs/certificates.md §3 against random choices of Φ, W, x, y, s and σ on the edge."""
    rng = np.random.default_rng(seed)
    low, m, end = rng.exponential(5.0), 1.0 + rng.exponential(2.0), rng.exponential(5.0)
    high = low * (1.0 + rng.uniform(0.0, 0.2)) + 1e-3
    numbers = {key: arb(getattr(k, key)) for key in ("rho", "delta", "kappa", "t", "alpha", "beta", "power", "omega")}
    numbers |= {"coupling": arb(k.coupling), "nu": arb(k.nu) if np.isfinite(k.nu) else None}
    if not checker._closed(numbers, arb(m), arb(end), arb(low), arb(high)):
        return
    share = rng.random(20_000)
    phi, w = end + share * (high - low) / m, high - share * (high - low)
    y0 = np.sqrt(2.0 * k.kappa * w)
    y = np.minimum(y0 + rng.exponential(k.t, 20_000), np.sqrt(2.0 * k.nu * w))
    x = np.sqrt(2.0 * k.rho * phi) + rng.exponential(rng.uniform(0.01, 3.0), 20_000) * (rng.random(20_000) < 0.7)
    s = rng.choice([1.0, 1.0, -0.5], 20_000) * x * y / np.sqrt(k.delta)
    growth = (m - k.coupling) * s - m * x**2 - (1.0 - k.beta) * y**2 + k.alpha * x * y - 2.0 * k.omega * w + k.t * y
    assert growth.max() <= 1e-9 * (m * x**2 + y**2).max()


# What is better than proved is refused

LOWER, HIGHER = 0.99, 1.01
BETTER = {
    ("constants", "rho"): HIGHER,
    ("constants", "delta"): HIGHER,
    ("constants", "kappa"): HIGHER,
    ("constants", "nu"): LOWER,
    ("constants", "t"): LOWER,
    ("constants", "alpha"): LOWER,
    ("constants", "power"): LOWER,
    ("inertia", 0, "value"): LOWER,
    ("inertia", 1, "value"): HIGHER,
    ("inertia", 2, "value"): LOWER,
    ("inertia", 3, "value"): HIGHER,
    ("level", "c"): 1.1,  # V∞ is the least there is, and c not the largest for it
    ("level", "storage"): LOWER,
    ("level", "rate"): HIGHER,
    ("polygon", "start"): LOWER,
    ("bounds", "potential"): LOWER,
    ("bounds", "error"): LOWER,
    ("bounds", "joint_errors"): LOWER,
    ("start", "error"): LOWER,
    ("start", "joint_errors"): LOWER,
    # premises that ask for more than was proved
    ("law", "stiffness"): LOWER,
    ("law", "rate"): LOWER,
    ("law", "floor"): LOWER,
    ("law", "omega"): LOWER,
    ("disturbance", "box"): HIGHER,
    ("friction", "coulomb"): HIGHER,
    ("friction", "viscous"): HIGHER,
    ("friction", "fed_coulomb"): LOWER,
    ("friction", "transition"): HIGHER,  # these two where there is friction to be fed forward
    ("friction", "speed"): HIGHER,
    ("start", "storage"): HIGHER,
}
"""Numbers that carry the proof, and what makes each of them better than what was proved."""


def part_of(document, path):
    for key in path:
        document = document[key]
    return document


def leaves(value, path=()):
    """Paths of all numbers."""
    if isinstance(value, dict | list):
        for key, part in value.items() if isinstance(value, dict) else enumerate(value):
            yield from leaves(part, (*path, key))
    elif isinstance(value, float):
        yield path


def changed(document, path, change):
    new = copy.deepcopy(document)
    holder = part_of(new, path[:-1])
    holder[path[-1]] = change(holder[path[-1]])
    return new


@lru_cache(maxsize=64)
def tree_of(arm):
    with ctx.workprec(checker.BITS):
        return checker._arm(json.loads(arm), None)


def is_refused(document, path):
    """Whether `verify` does not confirm the document: its parts up to the first that fails, the longest last."""
    try:
        document = read_document(written(document, path))
        if document["label"] != "PROVED":
            return True
        with ctx.workprec(checker.BITS):
            for part in (checker.stated, checker._constants, checker._levels, checker._errors):
                if any(check.status in (OPEN, FALSE) for check in part(document)):
                    return True
            tree, checks = tree_of(json.dumps(document["arm"]))
            return any(check.status in (OPEN, FALSE) for check in (*checks, *checker._inertias(document, tree)))
    except FileFormatError:
        return True


def test_what_is_refused_part_by_part_is_what_verify_refuses(rubbing, tmp_path):
    """Of one edit in every part, and of none."""
    file = tmp_path / "c.json"
    for path in (
        ("constants", "rho"),
        ("level", "storage"),
        ("bounds", "error"),
        ("inertia", 1, "value"),
        ("arm", "joints", 1, "mass"),
        ("conditions", 0, "right"),
        ("disturbance", "box", 0),
    ):
        for factor in (0.9, 1.0, 1.1):
            new = changed(rubbing, path, lambda x, by=factor: by * x)
            assert is_refused(new, file) is not verify(written(new, file)).confirmed


@pytest.mark.parametrize("fixture", DOCUMENTS)
def test_a_number_that_is_better_than_proved_is_refused(fixture, request, tmp_path):
    """Every entry alone, in a file that is sealed again, so that only the mathematics can tell."""
    document, passed, tried = request.getfixturevalue(fixture), [], 0
    for path, factor in BETTER.items():
        if document[path[0]] is None or (path[-1] in ("transition", "speed") and fixture != "rubbing"):
            continue
        part = part_of(document, path)
        for rest in [()] if isinstance(part, float) else leaves(part):
            whole, tried = (*path, *rest), tried + 1
            new = changed(document, whole, lambda x, by=factor: by * x)
            if new != document and not is_refused(new, tmp_path / "c.json"):
                passed.append(whole)
    assert passed == []
    assert tried > 20


@pytest.mark.parametrize("fixture", DOCUMENTS[:-1])
def test_another_arm_is_refused(fixture, request, tmp_path):
    """Every number of the tree, and every end of travel that is narrower than the URDF's."""
    document, passed = request.getfixturevalue(fixture), []
    for rest in list(leaves(document["arm"]["joints"]))[:: 4 if fixture == "panda" else 1]:
        path = ("arm", "joints", *rest)
        by = {"lower": 0.01, "upper": -0.01}.get(path[3], 0.01 * abs(part_of(document, path)))
        new = changed(document, path, lambda x, by=by: x + by)
        if abs(by) > 1e-9 and not is_refused(new, tmp_path / "c.json"):
            passed.append(path)
    assert passed == []
    for key, value in (
        ("armature", 0.01),
        ("prismatic", True),
        ("continuous", True),
        ("name", "nobody"),
        ("parent", 0),
    ):
        path = ("arm", "joints", 0, key)
        joint = copy.deepcopy(document)
        joint["arm"]["joints"][0][key] = (not part_of(document, path)) if isinstance(value, bool) else value
        assert is_refused(joint, tmp_path / "c.json"), key


@pytest.mark.parametrize("fixture", DOCUMENTS)
def test_other_multipliers_and_edges_are_refused(fixture, request, tmp_path):
    document, file = request.getfixturevalue(fixture), tmp_path / "c.json"
    for k in range(4):
        h = document["inertia"][k]["multipliers"]
        paths = [("inertia", k, "multipliers", i) for i in range(len(h))]
        # Some leave room, and whatever passes is a proof; those that are tight leave none.
        assert any(is_refused(changed(document, path, lambda x: HIGHER * x), file) for path in paths)
        for change in (lambda x: -x, lambda x: 0.0):
            assert is_refused(changed(document, paths[int(np.argmax(np.abs(h)))], change), file)
        assert is_refused(changed(document, paths[0][:3], lambda h: h[:-1]), file)
        assert is_refused(changed(document, paths[0][:3], lambda h: [*h, 0.0]), file)
    cut = document["polygon"]
    for i, m in list(enumerate(cut["steepness"]))[::7]:
        if m < 9e3:  # the steepest that is ever tried is 1e4
            assert is_refused(changed(document, ("polygon", "steepness", i), lambda m: 1.06 * m), file), i
    assert is_refused(changed(document, ("polygon", "steepness"), lambda m: [0.9] * len(m)), file)
    shorter = copy.deepcopy(document)
    shorter["polygon"]["steepness"].pop(), shorter["polygon"]["heights"].pop()
    assert is_refused(shorter, file)
    assert is_refused({**document, "polygon": None}, file)


def test_a_travel_multiplier_below_zero_is_refused(slider):
    """−h of a form that is ≤ 0 on all motions would prove too much."""
    with ctx.workprec(192):
        links, h = stated_tree(slider["arm"]["joints"]), slider["inertia"][0]["multipliers"]
        assert len(h) == 2 + 4
        assert energy_form(links, balls(np.eye(3)), -1, h) is not None
        assert energy_form(links, balls(np.eye(3)), -1, [h[0], -1e-9, *h[2:]]) is None


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_any_edit_without_a_new_seal_is_refused(rubbing, data, tmp_path_factory):
    path = data.draw(st.sampled_from(list(leaves(rubbing))))
    factor = data.draw(st.floats(0.5, 2.0).filter(lambda x: x != 1.0))
    new = changed(rubbing, path, lambda x: factor * x if x else factor)
    if new == rubbing:
        return
    file = tmp_path_factory.mktemp("edited") / "c.json"
    file.write_text(json.dumps({**new, "sha256": seal(rubbing)}))
    with contextlib.suppress(FileFormatError):
        assert "the file is as it was written" in statuses(verify(file), FALSE)


def test_a_condition_that_is_flipped_is_refused(rubbing, tmp_path):
    for i, condition in enumerate(rubbing["conditions"]):
        if condition["role"] == "comparison":
            continue
        new = changed(rubbing, ("conditions", i, "holds"), lambda holds: not holds)
        assert is_refused(new, tmp_path / "c.json")
        new = copy.deepcopy(rubbing)
        new["conditions"][i] |= {"left": condition["right"], "right": condition["left"]}
        assert is_refused(new, tmp_path / "c.json"), condition
    for i in range(len(rubbing["claims"])):
        assert is_refused(changed(rubbing, ("claims", i, "label"), lambda _: "EMPIRICAL"), tmp_path / "c.json")
    assert is_refused({**rubbing, "label": "VERIFIED"}, tmp_path / "c.json")


def test_a_void_certificate_stays_void_whatever_its_label(tmp_path):
    reference = nbs.Sinusoid.for_robot(nbs.load_robot("two_link"))
    bound = certified("two_link", disturbance=1e4, reference=reference)
    assert bound.void
    document = certificate_document(bound)
    for label in ("EMPIRICAL", "PROVED"):
        found = verify(written({**document, "label": label}, tmp_path / "c.json"))
        assert not found.confirmed
        assert set(bound.void) <= set(statuses(found, FALSE))
        assert ("label PROVED" in statuses(found, FALSE)) == (label == "PROVED")


# What cannot be verified is said


def test_bounds_by_other_methods_are_not_re_verified(monkeypatch, tmp_path):
    monkeypatch.setattr(multipliers, "maximise", lambda constant, terms, positive: (np.zeros(len(terms)), False))
    bound = certified("two_link")
    assert bound.label == "PROVED"
    found = verify(write_certificate(bound, tmp_path / "c.json"))
    assert not found.confirmed
    assert len(statuses(found, OPEN)) == 4
    assert statuses(found, FALSE) == []
    assert all("PROVED: " in check.because for check in found.checks if check.status == OPEN)


def test_a_learned_model_is_not_confirmed(tmp_path):
    robot = nbs.load_robot("two_link")
    law = nbs.NeuralBackstepping.for_robot(robot, dynamics=nbs.AnalyticDynamics(robot=robot))
    found = verify(write_certificate(nbs.certify(law, [1.0, 1.0]), tmp_path / "c.json"))
    assert statuses(found, OPEN) == ["the tree is the arm's"]
    assert statuses(found, FALSE) == []


def test_the_arm_is_held_to_a_urdf_that_is_given(tmp_path, panda):
    moved = tmp_path / "elsewhere.urdf"
    moved.write_text(find("panda").path.read_text())
    file = written(changed(panda, ("arm", "urdf"), lambda _: "/nowhere/panda.urdf"), tmp_path / "c.json")
    assert statuses(verify(file), OPEN) == ["the tree is the arm's"]
    assert verify(file, urdf=moved).confirmed
    moved.write_text(find("panda").path.read_text().replace('mass value="', 'mass value="1'))
    assert "the tree is the arm's" in statuses(verify(file, urdf=moved), FALSE)
    with pytest.raises(
        FileFormatError, match=r"not the URDF of this certificate \(it has no joint 'panda_joint1'\); give its own\.$"
    ):
        verify(file, urdf=find("two_link").path)
    moved.write_text("<robot")
    with pytest.raises(FileFormatError, match="not the URDF"):
        verify(file, urdf=moved)
    with pytest.raises(FileNotFoundError):
        verify(file, urdf=tmp_path / "nothing.urdf")


@pytest.mark.parametrize("name", nbs.ROBOT_NAMES)
def test_every_known_arm_is_read_as_it_is(name):
    robot = nbs.load_robot(name)
    joints = certificate_document(certified(name, friction=nbs.JointFriction(*np.zeros((2, robot.nv)))))["arm"][
        "joints"
    ]
    with ctx.workprec(192):
        assert differences(stated_tree(joints), urdf_tree(find(name).path, joints)) == []


@pytest.mark.parametrize(
    ("stated", "felt"),
    [('armature="0.3" motor_inertia="9"', 0.3), ('motor_inertia="2e-5" gear_ratio="100"', 0.2), ('damping="1"', 0.0)],
)
def test_rotors_are_read_from_a_urdf(tmp_path, stated, felt):
    text = find("two_link").path.read_text()
    path = tmp_path / "arm.urdf"
    path.write_text(text.replace('effort="100" velocity="20"/>', f'effort="100" velocity="20"/><dynamics {stated}/>'))
    robot = nbs.load_robot(str(path))
    joints = certificate_document(certified(str(path)))["arm"]["joints"]
    assert [joint["armature"] for joint in joints] == pytest.approx([felt, felt], abs=1e-15)
    with ctx.workprec(192):
        assert differences(stated_tree(joints), urdf_tree(path, joints)) == []
    joints[0]["armature"] += 1e-6
    with ctx.workprec(192):
        assert differences(stated_tree(joints), urdf_tree(path, joints)) == ["rotor inertia of joint 1"]
    np.testing.assert_allclose(robot.armature, felt, atol=1e-15)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("two_link", {"armature": 0.2}),
        ("two_link", {"payload": {"tip": {"mass": 1.0, "com": [0.0, 0.1, 0.0], "inertia": 0.01}}}),
        ("two_link", {"base_rpy": [0.5, 0.2, 0.1], "base_xyz": [0.0, 0.0, 1.0]}),
        ("three_link", {"lock": {"joint2": 0.3}}),
    ],
)
def test_what_is_added_to_a_file_is_checked_against_the_description_with_it(name, options, tmp_path):
    """The file alone is another arm: neither confirmed by it nor found false."""
    robot = nbs.load_robot(name, **options)
    certificate = nbs.certify(nbs.NeuralBackstepping.for_robot(robot), np.full(robot.nv, 2.0))
    path, description = nbs.write_certificate(certificate, tmp_path / "c.json"), tmp_path / "arm.urdf"
    assert statuses(verify(path), OPEN) == ["the tree is the arm's"]
    description.write_bytes(robot.urdf.without_geometry())
    assert verify(path, urdf=description).confirmed
    assert not statuses(verify(path), FALSE)
    assert "the tree is the arm's" in statuses(verify(path, urdf=find(name).path), FALSE)


def test_premises_are_listed(rubbing, tmp_path):
    taken = statuses(verify(written(rubbing, tmp_path / "c.json")), TAKEN)
    assert {"disturbance", "law SlotineLi", "joint friction and |v_d|", "V(0) of the start"} <= set(taken)
    assert {x["name"] for x in rubbing["conditions"] if x["role"] != "comparison"} <= set(taken)
    assert {x["assumption"] for x in rubbing["assumptions"]} <= set(taken)


def test_the_robot_that_is_given_must_be_the_one_that_was_certified(panda, tmp_path):
    """Its numbers, its gravity and its locked joints."""
    file = written(panda, tmp_path / "c.json")
    found = verify(file, robot=nbs.load_robot("panda"))
    assert found.confirmed
    (held,) = [check for check in found.checks if check.name == "joints held at zero"]
    assert held.status == TAKEN
    assert all(name in held.because for name in find("panda").options["lock"])
    for robot, words in (
        (
            nbs.load_robot("panda", lock=(*find("panda").options["lock"], "panda_joint7")),
            r"that move are .* same joints locked\.$",
        ),
        (nbs.load_robot("panda", gravity=[0.0, 0.0, 9.81]), r"with the sha256 .*, with its gravity\.$"),
        (nbs.load_robot("ur5"), "same joints locked"),
    ):
        with pytest.raises(FileFormatError, match=words):
            verify(file, robot=robot)
    nobody = written({**panda, "arm": {**panda["arm"], "sha256": None}}, tmp_path / "c.json")
    with pytest.raises(FileFormatError, match="names no arm"):
        verify(nobody, robot=nbs.load_robot("panda"))


@pytest.mark.parametrize("name", ["mass", "inertia", "armature"])
def test_an_inertia_that_is_not_positive_in_every_pose_is_refused(panda, name, tmp_path):
    """A law with ωM in its damping needs no bound of M, but V ≥ Φ needs M ⪰ 0."""
    document = copy.deepcopy(panda)
    for line in document["inertia"]:
        line |= {"value": 0.0, "label": "EMPIRICAL", "multipliers": None}
    document["constants"] |= {"kappa": 0.0, "nu": None}
    whole = document["arm"]["joints"][-1]
    less = {"mass": -0.1, "inertia": (-np.eye(3)).tolist(), "armature": -0.1}[name]
    with ctx.workprec(192):
        for joint, wanted in ((whole, VERIFIED), (whole | {name: less}, FALSE)):
            joints = [*document["arm"]["joints"][:-1], joint]
            (found,) = list(checker._inertias(document, stated_tree(joints)))
            assert (found.name, found.status) == ("M ≻ 0 in every pose", wanted)


def test_conditions_along_a_reference_are_not_checked_and_say_so(rubbing, tmp_path):
    file = tmp_path / "c.json"
    found = {check.name: check for check in verify(written(rubbing, file)).checks}
    along = [x for x in rubbing["conditions"] if x["checks"] is not None and x["role"] != "comparison"]
    assert {"no joint reaches its stop", "torques stay within the effort limits"} <= {x["checks"] for x in along}
    assert all(found[x["name"]].because.endswith("not checked") for x in along)


def test_the_room_to_the_stops_is_held_against_the_bound_of_the_file(rubbing, tmp_path):
    """A smaller error in the condition than in the bounds leaves room that there is not."""
    (i,) = [i for i, x in enumerate(rubbing["conditions"]) if x["name"].startswith("room of")]
    assert verify(written(rubbing, tmp_path / "c.json")).confirmed
    for change in (
        changed(rubbing, ("conditions", i, "right"), lambda x: 0.999 * x),
        changed(rubbing, ("conditions", i, "name"), lambda x: x.replace("joint", "link")),
    ):
        found = verify(written(change, tmp_path / "c.json"))
        assert f"{change['conditions'][i]['name']}: right side" in statuses(found, FALSE)


def test_no_assumption_is_checked_without_its_conditions(rubbing, tmp_path):
    dropped = copy.deepcopy(rubbing)
    dropped["conditions"] = [x for x in rubbing["conditions"] if x["checks"] != "no joint reaches its stop"]
    assert statuses(verify(written(dropped, tmp_path / "c.json")), FALSE) == ["no joint reaches its stop"]
    i = [x["assumption"] for x in rubbing["assumptions"]].index("no joint reaches its stop")
    honest = changed(dropped, ("assumptions", i, "checked"), lambda _: "not checked")
    assert verify(written(honest, tmp_path / "c.json")).confirmed


# Files that are no certificates, and the shell

FAULTS = {
    "": "no certificate of format 1",
    "[]": "not of type 'object'",
    "{": "no certificate of format 1",
    '{"a": NaN}': "not finite",
    '{"a": 1e999}': "not finite",
    '{"a": 1, "a": 2}': "a key is repeated",
    "[" * 100_000: "no certificate of format 1",
}


@pytest.mark.parametrize("text", FAULTS, ids=lambda text: text[:12])
def test_a_file_that_is_none_is_refused_in_one_sentence(text, tmp_path):
    path = tmp_path / "c.json"
    path.write_text(text)
    with pytest.raises(FileFormatError) as caught:
        verify(path)
    assert FAULTS[text] in str(caught.value)
    assert str(caught.value).endswith("; write the file again.")


def test_another_file_of_a_command_is_told_from_a_certificate(tmp_path):
    path = tmp_path / "summary.json"
    path.write_text('{"command": "certify"}')
    with pytest.raises(FileFormatError) as caught:
        verify(path)
    expected = "not a certificate; give certificate.json, as nbs-pin certify --json writes it."
    assert str(caught.value) == f"{path}: {expected}"


def test_keys_types_and_sizes_are_checked(rubbing, tmp_path):
    def message(document):
        with pytest.raises(FileFormatError) as caught:
            verify(written(document, tmp_path / "c.json"))
        text = str(caught.value)
        assert "\n" not in text
        assert len(text) < 400
        return text

    assert "'arm' is a required property" in message({key: x for key, x in rubbing.items() if key != "arm"})
    assert "'more' was unexpected" in message({**rubbing, "more": 1})
    assert "$.format" in message({**rubbing, "format": "nbs_pin certificate 2"})
    assert "$.constants.rho" in message(changed(rubbing, ("constants", "rho"), lambda _: "8"))
    assert "$.constants.rho" in message(changed(rubbing, ("constants", "rho"), lambda x: -x))
    assert "$.law.coupling" in message(changed(rubbing, ("law", "coupling"), lambda _: True))
    assert "do not all fit 2 joints" in message(changed(rubbing, ("law", "floor"), lambda x: x[:1]))
    assert "do not all fit 2 joints" in message(changed(rubbing, ("friction", "speed"), lambda x: [*x, 1.0]))
    assert "do not all fit 2 joints" in message(changed(rubbing, ("arm", "joints"), lambda x: x[:1]))
    assert "not symmetric" in message(changed(rubbing, ("law", "stiffness", 0, 1), lambda x: x + 1.0))
    assert "as many heights" in message(changed(rubbing, ("polygon", "heights"), lambda x: x[:-1]))
    assert "before its parent" in message(changed(rubbing, ("arm", "joints", 0, "parent"), lambda _: 1))
    assert "no rotation" in message(
        changed(rubbing, ("arm", "joints", 0, "rotation"), lambda _: np.ones((3, 3)).tolist())
    )
    assert "$.disturbance" in message(changed(rubbing, ("disturbance", "radius"), lambda _: 1.0))


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_a_mutilated_file_is_read_or_refused_and_nothing_else(rubbing, data, tmp_path_factory):
    """A value of any kind in any place, or nothing there."""
    document = copy.deepcopy(rubbing)
    path = data.draw(st.sampled_from(list(nodes(rubbing))))
    holder, kinds = (
        part_of(document, path[:-1]),
        [None, "x", -1, 0.0, [], {}, 1e308, 1e-308, -1e308, True, 2**70, [1.0]],
    )
    if data.draw(st.integers(0, 5)) == 0:
        del holder[path[-1]]
    else:
        holder[path[-1]] = data.draw(st.sampled_from(kinds))
    file = written(document, tmp_path_factory.mktemp("mutilated") / "c.json")
    try:
        verify(file)
    except FileFormatError as error:
        assert "\n" not in str(error)  # noqa: PT017


def nodes(value, path=()):
    """Paths of everything but the whole."""
    if isinstance(value, dict | list):
        for key, part in value.items() if isinstance(value, dict) else enumerate(value):
            yield (*path, key)
            yield from nodes(part, (*path, key))


def test_the_shell_writes_and_verifies(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    folder = tmp_path / "out"
    certify = ["certify", "two_link", "--disturbance", "2", "--out", str(folder)]
    assert cli.main([*certify, "--json"]) == 0
    file = folder / "certificate.json"
    assert str(file) in capsys.readouterr().out
    assert cli.main(["verify", str(file)]) == 3
    assert "‖z1‖ with held torques" in capsys.readouterr().out
    assert cli.main([*certify, "--json", "--force", "--period", "0.005"]) == 0
    capsys.readouterr()
    assert cli.main(["verify", str(file), "-v"]) == 0
    printed = capsys.readouterr().out
    assert "PROVED, and re-verified in 19 checks" in printed
    assert "not checked" in printed
    assert cli.main(["verify", str(file), "--robot", "two_link"]) == 0
    assert cli.main(["verify", str(file), "--robot", "ur5"]) == 2
    assert "give the robot with the same joints locked" in capsys.readouterr().err
    assert "4 multipliers, §6" in printed
    document = json.loads(file.read_text())
    file.write_text(json.dumps(changed(document, ("constants", "rho"), lambda x: 1.01 * x)))
    assert cli.main(["verify", str(file)]) == 3
    printed = capsys.readouterr().out
    assert "not shown true" in printed
    assert "not confirmed: " in printed
    file.write_text("{}")
    assert cli.main(["verify", str(file)]) == 2
    assert "nbs-pin: error: " in capsys.readouterr().err
    assert cli.main(["verify", str(tmp_path / "nothing.json")]) == 2
    assert cli.main([*certify, "--force"]) == 0
    assert not file.exists()


def test_without_its_extra_the_command_is_named(monkeypatch):
    for name in [name for name in sys.modules if name.startswith("nbs_pin.verification")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "flint", None)
    with pytest.raises(MissingExtra, match=r"pip install 'nbs-pin\[verify\]'"):
        importlib.import_module("nbs_pin.verification.verify")


@pytest.mark.parametrize("what", ["assumptions", "theorem", "comparison"])
def test_no_premise_can_be_left_out_or_made_a_comparison(what, tmp_path):
    robot = nbs.load_robot("two_link")
    law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    document = certificate_document(nbs.certify(law, [5.0, 5.0], reference=reference))
    if what == "assumptions":
        document["assumptions"] = document["assumptions"][:-1]
    elif what == "theorem":
        document["conditions"] = document["conditions"][1:]
    else:
        document["conditions"][-1]["role"] = "comparison"
    file = tmp_path / "certificate.json"
    file.write_text(json.dumps(document | {"sha256": seal(document)}))
    with pytest.raises(FileFormatError, match=r"does not list|no condition|counts as a comparison"):
        nbs.verify(file)


def test_friction_known_to_a_share_has_no_file():
    robot = nbs.load_robot("two_link")
    law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    friction = nbs.JointFriction(np.array([0.3, 0.2]), np.array([0.5, 0.2]))
    given = {"reference": reference, "friction": friction, "uncertainty": nbs.Uncertainty(coulomb=0.5)}
    with pytest.raises(nbs.ArgumentError, match="known to a share"):
        certificate_document(nbs.certify(law, [5.0, 5.0], **given))


def test_a_urdf_whose_joints_come_in_another_order_is_told(tmp_path):
    document = certificate_document(nbs.certify(build_law("nbs", nbs.load_robot("two_link")), [5.0, 5.0]))
    first, second = document["arm"]["joints"]
    first["name"], second["name"] = second["name"], first["name"]
    file = tmp_path / "certificate.json"
    file.write_text(json.dumps(document | {"sha256": seal(document)}))
    with pytest.raises(FileFormatError, match="before its parent"):
        verify(file)
