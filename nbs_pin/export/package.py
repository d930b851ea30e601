"""Everything that goes with a law in C: self-test, Makefile, and what a robot's middleware needs."""

import json
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
from jaxtyping import Float

from nbs_pin.base.files import write_whole
from nbs_pin.export.law import Exported, law_files
from nbs_pin.export.reals import Precision, Real
from nbs_pin.export.templates import filled

TOLERANCE: dict[Precision, float] = {"double": 1e-12, "float": 1e-4}
"""How far the torques of C may be from those of Python, as a share of the torque's size."""
_FRANKA_JOINTS = 7
_FRANKA_ROW = "| `libfranka/` | an example for libfranka |\n"
_MODEL_INCLUDE = "#include <franka/model.h>\n"
_MODEL = "    const franka::Model model = robot.loadModel();\n"
_WEIGHT = "      const auto weight = model.gravity(state);  // libfranka's torques are without it\n"


@dataclass(frozen=True, eq=False)
class Steps:
    """Control steps, one after the other from a fresh state, and the torques that Python computes for them."""

    period: float
    """[s]."""
    given: Float[np.ndarray, "5 steps n"]
    """q, v, q_ref, v_ref, a_ref."""
    torque: Float[np.ndarray, "steps n"]
    """The law's [N·m]."""


def write_package(folder: Path, exported: Exported, steps: Steps) -> list[Path]:
    """Write the law and what goes with it into the folder, and return the files."""
    files = law_files(exported) | _around(exported, steps)
    return [write_whole(folder / name, text.encode()) for name, text in files.items()]


def sent(exported: Exported, steps: Steps) -> Float[np.ndarray, "steps n"]:
    """The torques within the limits of effort and rate, from a torque of 0 on."""
    limited, last = np.empty_like(steps.torque), np.zeros(exported.nv)
    change, most = exported.rate_limit * steps.period, exported.effort_limit
    for k, tau in enumerate(steps.torque):
        rated = last + np.clip(tau - last, -change, change) if np.isfinite(change).any() else tau  # as C rounds it
        limited[k] = last = np.clip(rated, -most, most)
    return limited


def _around(exported: Exported, steps: Steps) -> dict[str, str]:
    name, package = exported.name, f"{exported.name.lower()}_controller"
    rows = np.concatenate([steps.given, steps.torque[None], sent(exported, steps)[None]]).swapaxes(0, 1)
    franka, single = exported.nv == _FRANKA_JOINTS, exported.real.precision == "float"
    words = exported.words | {
        "COUNT": len(rows),
        "STEPS": ",\n".join(_row(row, exported.real) for row in rows),
        "PERIOD": exported.real.literal(steps.period),
        "TOLERANCE": f"{TOLERANCE[exported.real.precision]:g}",
        # The parts of a torque may cancel: in float, what is left of them is compared with the size of a usual torque.
        "SMALLEST_SIZE": f"{np.median(np.abs(steps.torque).max(axis=1)) if single else 0.0:.6g}",
        "OR_MEDIAN": ", or of the median torque's where that is larger" if single else "",
        "SUFFIX": exported.real.suffix,
        "PACKAGE": package,
        "TITLE_XML": escape(exported.title),
        "JOINTS": ", ".join(json.dumps(joint) for joint in exported.joint_names),
        "FRANKA_ROW": _FRANKA_ROW if franka else "",
        "FRANKA_WORDS": " and the example for libfranka were" if franka else " was",
        "MODEL_INCLUDE": _MODEL_INCLUDE if exported.has_weight else "",
        "MODEL": _MODEL if exported.has_weight else "",
        "WEIGHT": _WEIGHT if exported.has_weight else "",
        "PLUS_WEIGHT": " + weight[i]" if exported.has_weight else "",
        "MINUS_WEIGHT": " - weight[i]" if exported.has_weight else "",
    }
    places = {
        "selftest.c": "selftest.c",
        "Makefile": "Makefile",
        "README.md": "README.md",
        "ros2_control/package.xml": "package.xml",
        "ros2_control/CMakeLists.txt": "CMakeLists.txt",
        f"ros2_control/{name}_controller.xml": "plugin.xml",
        f"ros2_control/{name}_controller.cpp": "controller.cpp",
    }
    if franka:
        places[f"libfranka/{name}_franka.cpp"] = "franka.cpp"
    return {place: filled(template, words) for place, template in places.items()}


def _row(row: Float[np.ndarray, "7 n"], real: Real) -> str:
    vectors = (", ".join(real.literal(x) for x in vector) for vector in row)
    return "    {" + ",\n     ".join(f"{{{vector}}}" for vector in vectors) + "}"
