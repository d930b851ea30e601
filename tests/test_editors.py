"""What an editor and a notebook show of the public names: types, completions, one line, a small table."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import jedi
import numpy as np
import pytest

import nbs_pin as nbs

ROOT = Path(__file__).parent.parent
STUB = ROOT / "nbs_pin" / "__init__.pyi"


def public_names():
    """The names that the stub re-exports."""
    imports = [node for node in ast.parse(STUB.read_text()).body if isinstance(node, ast.ImportFrom)]
    return sorted(alias.asname for node in imports for alias in node.names)


def test_mypy_knows_the_type_of_every_public_name_and_refuses_a_misspelt_one(tmp_path):
    names = public_names()
    lines = ["import nbs_pin as nbs", *(f"reveal_type(nbs.{name})" for name in names)]
    lines += ["reveal_type(nbs.load_robot('panda').effort_limit)", "nbs.plot_traking"]
    (tmp_path / "user.py").write_text("\n".join(lines))
    # The settings and the cache of `make check`, without which all of torch would be analysed again.
    command = [sys.executable, "-m", "mypy", "--config-file", "pyproject.toml", str(tmp_path / "user.py")]
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False).stdout
    revealed = re.findall(r'Revealed type is "(.*)"', told)
    assert len(revealed) == len(names) + 1, told
    untyped = [name for name, kind in zip(names, revealed, strict=False) if kind == "Any"]
    assert untyped == []
    assert revealed[-1].startswith("numpy.ndarray")
    (error,) = [line for line in told.splitlines() if ": error: " in line]
    assert "plot_traking" in error
    assert "plot_tracking" in error


def test_an_editor_completes_the_package_an_arm_and_the_arguments_of_a_call():
    lines = ["import nbs_pin as nbs", "robot = nbs.load_robot('panda')", "robot.", "nbs.", "nbs.simulate("]
    script = jedi.Script("\n".join(lines), path=ROOT / "user.py", project=jedi.Project(ROOT, sys_path=sys.path))
    of_package = {found.name for found in script.complete(4, 4)}
    assert set(public_names()) <= of_package
    of_robot = {found.name for found in script.complete(3, 6)}
    assert {"joint_names", "effort_limit", "pose", "with_payload", "nv"} <= of_robot
    (signature,) = script.get_signatures(5, 13)
    assert [given.name for given in signature.params][:5] == ["plant", "controller", "reference", "duration", "period"]


def public_objects():
    robot = nbs.load_robot("two_link")
    law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    plant = nbs.DynamicsPlant.for_robot(robot)
    run = nbs.simulate(plant, law, reference, 0.1, 0.001)
    certificate = nbs.certify(law, [5.0, 5.0], reference=reference, duration=0.5)
    model = nbs.PinocchioDynamics(robot)
    laws = (nbs.ComputedTorque, nbs.PD, nbs.PID, nbs.SlotineLi, nbs.SlidingMode)
    return [
        nbs.transient_bound(nbs.AdaptiveLaw(law, load_mass=0.5), 0.5),
        nbs.ChangingPlant(plant, [(0.5, nbs.MujocoPlant(robot))]),
        robot, law, law.compile(), *(kind.for_robot(robot) for kind in laws), nbs.PID.for_robot(robot).compile(), model,
        nbs.AnalyticDynamics(), plant, nbs.MujocoPlant(robot), run, certificate, nbs.Watch(certificate),
        nbs.monitor(run, certificate), nbs.compare(model, model, samples=10, motions=0), reference,
        nbs.MinimumJerk([[0.0, 0.0], [1.0, 1.0]], [0.0, 2.0]), nbs.Sampled(run.t, run.q),
        nbs.ToolPath.line([0.5, 0.0, 0.3], [0.0, 0.0, 0.1]), nbs.collect(robot, "uniform", 20),
    ]  # fmt: skip


def test_every_object_is_told_in_one_short_line_and_a_small_table():
    for shown in public_objects():
        line, page = repr(shown), shown._repr_html_()
        assert re.fullmatch(rf"{type(shown).__name__}\(.+\)", line)
        assert len(line) < 200
        assert "object at 0x" not in line
        assert len(page) < 3000
        for text in {"two_link", "2 joints"} & {part for part in re.split(r"[(),'] ?", line)}:
            assert text in page


@pytest.mark.parametrize(("shown", "words"), [
    (lambda robot: robot, "Robot('two_link', 2 joints, 2 kg, effort 200 N·m)"),
    (nbs.PinocchioDynamics, "PinocchioDynamics(two_link, 2 joints)"),
    (lambda robot: nbs.SlotineLi.for_robot(robot, bandwidth=4.0), "λ 4 1/s"),
    (lambda robot: nbs.NeuralBackstepping.for_robot(robot, bandwidth=4.0), "ω = 4 rad/s"),
])  # fmt: skip
def test_a_line_states_the_numbers_that_matter(shown, words):
    robot = nbs.load_robot("two_link").with_effort_limit(200.0)
    assert words in repr(shown(robot))


def test_a_run_and_a_certificate_are_told_with_units_one_pictures():
    robot = nbs.load_robot("two_link")
    law = nbs.NeuralBackstepping.for_robot(robot)
    certificate = nbs.certify(law, [5.0, 5.0])
    degrees = float(re.search(r"\(([\d.]+)°\)", repr(certificate))[1])
    assert degrees == pytest.approx(np.degrees(certificate.error), rel=0.05)
    assert repr(certificate).count("PROVED") == 1
    run = nbs.simulate(nbs.DynamicsPlant.for_robot(robot), law, nbs.Hold([0.1, 0.2]), 0.1, 0.002)
    assert repr(run) == "Run(two_link, 2 joints, 0.1 s at 2 ms)"


def test_names_in_a_notebook_are_text_and_no_markup(tmp_path):
    file = tmp_path / "arm.urdf"
    text = nbs.load_robot("two_link").urdf.xml.decode()
    file.write_text(re.sub(r'(<robot[^>]* name=)"[^"]*"', r'\1"&lt;script&gt;alert(1)"', text))
    page = nbs.load_robot(file)._repr_html_()
    assert "&lt;script&gt;" in page
    assert "<script" not in page
