"""The paper's Figure 5: three links, a model learned from data, and what its number says about that model."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nbs_pin.base.arrays import Matrices, Scalars, Vectors
from nbs_pin.base.csv_files import write_csv
from nbs_pin.base.plain import plain
from nbs_pin.base.progress import tracked
from nbs_pin.base.records import Run
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping, paper_controller
from nbs_pin.controllers.pd import PD
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.kernels.layout import Packed
from nbs_pin.motions.references import paper_reference
from nbs_pin.reports.markdown import Section, markdown_table, short
from nbs_pin.reports.plotting import ACTUAL, ERROR, LIMIT, REFERENCE, TORQUE, picture, thin
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.simulation import metrics
from nbs_pin.simulation.costs import squared_error
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.mujoco_plant import MujocoPlant
from nbs_pin.simulation.simulate import simulate
from nbs_pin.training.train import train

FILES = ("figure5.png", "figure5.csv")
"""What `write` writes."""
PRINTED = 1.5e-3
"""The paper's steady ‖z1‖² [rad²]."""
WITHOUT, WITH = "no gravity, Ĝ left out of the law", "gravity, Ĝ in the law"
"""The paper's set-up, and the one it speaks of."""
PD_GAINS = 20.0, 10.0
"""K_p [N·m/rad] and K_d [N·m·s/rad] of the PD beside it, which knows no model."""
PERIOD, TRAINING_PERIOD = 0.001, 0.01
"""Control period of the runs, which is the step of MuJoCo, and of the training [s]."""


class Weightless(DynamicsProvider):
    """A model with its gravity left out: M and C of it, G = 0, and no arm, so no limits."""

    def __init__(self, model: DynamicsProvider) -> None:
        self.model = model

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self.model.nv

    def mass_matrix(self, q: Vectors) -> Matrices:
        """M(q) [kg·m²] of the model."""
        return self.model.mass_matrix(q)

    def coriolis_matrix(self, q: Vectors, v: Vectors) -> Matrices:
        """C(q, v) [N·m·s] of the model."""
        return self.model.coriolis_matrix(q, v)

    def gravity(self, q: Vectors) -> Vectors:
        """0 [N·m]."""
        return 0.0 * q

    def potential_energy(self, q: Vectors) -> Scalars:
        """0 [J]."""
        return 0.0 * q[..., 0]

    def reference_torque(self, q: Vectors, v: Vectors, v_r: Vectors, a_r: Vectors) -> Vectors:
        """M a_r + C v_r [N·m]: the model's torque less the one that holds it still, by its fastest route to both."""
        rest = 0.0 * q
        return self.model.reference_torque(q, v, v_r, a_r) - self.model.reference_torque(q, rest, rest, rest)

    def packed_tree(self) -> Packed | None:
        """The model's tree, whose first weights, −g, are zero here."""
        tree = self.model.packed_tree()
        if tree is None:
            return None
        weights = tree.weights.copy()
        weights[:3] = 0.0
        return Packed(tree.layout, weights)


def trained_law(model: DynamicsProvider, epochs: int, seed: int = 0, progress: bool = False) -> NeuralBackstepping:
    """The paper's law on that model, its networks trained on it as the paper says, its gains left alone.

    ∫ z1ᵀz1 over 1 s from rest at zero, control at 10 ms, Adam at 1e-3. Raises KeyboardInterrupt when Ctrl-C ended it.
    """
    training = train(
        paper_controller(model, seed=seed),
        DynamicsPlant(model),
        [paper_reference(model.nv)],
        starts=np.zeros((1, model.nv)),
        duration=1.0,
        period=TRAINING_PERIOD,
        lookahead=0.0,
        cost=squared_error,
        gains=False,
        epochs=epochs,
        optimiser="adam",
        learning_rate=1e-3,
        progress=progress,
    )
    if training.stopped == "interrupted":
        raise KeyboardInterrupt
    law: Any = training.controller
    return law


def follow_again(
    learned: Mapping[str, DynamicsProvider],
    *,
    epochs: int = 200,
    duration: float = 100.0,
    seed: int = 0,
    progress: bool = False,
) -> dict[str, dict[str, Run]]:
    """Set-up -> law -> its run along the paper's reference from rest at zero, in MuJoCo, no torque limit or look-ahead.

    learned: models by name, with Ĝ. The NBS law is trained once, on the first of them without its gravity, and has the
    same networks on every model.
    """
    robot = load_robot("three_link")
    models = {"the exact model": PinocchioDynamics(robot), **learned}
    networks = trained_law(Weightless(next(iter(learned.values()))), epochs, seed, progress)
    laws: dict[tuple[str, str], Controller] = {}
    for setup in (WITHOUT, WITH):
        for name, model in models.items():
            believed = Weightless(model) if setup == WITHOUT else model
            laws[setup, f"NBS on {name}"] = NeuralBackstepping(believed, networks.potential, networks.damping)
        kp, kd = PD_GAINS
        laws[setup, f"PD ({kp:g}, {kd:g}), no model"] = PD(
            Weightless(models["the exact model"]), feedforward="gravity", kp=kp, kd=kd
        )
    runs: dict[str, dict[str, Run]] = {WITHOUT: {}, WITH: {}}
    for setup, name in tracked(list(laws), "the paper's Figure 5", progress):
        arm = load_robot("three_link", gravity=0.0) if setup == WITHOUT else robot
        runs[setup][name] = _followed(arm, laws[setup, name], duration)
    return runs


def write(runs: Mapping[str, Mapping[str, Run]], folder: Path) -> None:
    """The picture in the paper's form, and the figures."""
    _draw(runs, folder / FILES[0])
    rows = [[*entry.values()] for entry in figures(runs)]
    write_csv(folder / FILES[1], list(figures(runs)[0]), rows)


def figures(runs: Mapping[str, Mapping[str, Run]]) -> list[dict[str, Any]]:
    """One entry per run."""
    return [
        {
            "setup": setup,
            "law": name,
            "steady_error_rad2": float(metrics.steady_error(run)),
            "convergence_time_s": float(metrics.convergence_time(run)),
            "peak_torque_Nm": float(metrics.peak_torque(run)),
        }
        for setup, several in runs.items()
        for name, run in several.items()
    ]


def section(runs: Mapping[str, Mapping[str, Run]]) -> Section:
    """The part of the page that tells of it."""
    found = figures(runs)
    names = list(runs[WITHOUT])
    steady = {(x["setup"], x["law"]): x["steady_error_rad2"] for x in found}
    head = ["", "no gravity: steady ‖z1‖² [rad²]", "gravity: steady ‖z1‖² [rad²]", "no gravity: peak torque [N·m]",
            "gravity: peak torque [N·m]"]  # fmt: skip
    peak = {(x["setup"], x["law"]): x["peak_torque_Nm"] for x in found}
    lines = [
        [name, *(short(steady[s, name]) for s in (WITHOUT, WITH)), *(short(peak[s, name]) for s in (WITHOUT, WITH))]
        for name in names
    ]
    without, within = ([name for name in names if steady[s, name] <= PRINTED] for s in (WITHOUT, WITH))
    text = f"""
The paper reports ‖z1‖² ≤ {PRINTED:g} along q_d = [sin 0.1t, cos 0.1t, sin 0.1t] for the law on its learned model, in
MuJoCo, from rest at zero. Its program ran that with gravity switched off and Ĝ left out of the law (docs/theory.md §8).
The same again: control at 1 ms, {runs[WITHOUT][names[0]].t[-1]:g} s, no torque limit; the paper's networks, trained
once, under every model. Steady: largest ‖z1‖² of the last 30 %.

{markdown_table(head, lines)}

At or below the paper's {PRINTED:g} without gravity: {"; ".join(without) or "none"}.
A number that a law without a model reaches says nothing about a learned one. With gravity, where the law
needs Ĝ: {"; ".join(within) or "none"}.

![The paper's Figure 5, without and with gravity](figure5.png)

Solid, dashed and dotted: joints 1, 2 and 3; black: desired; dashed grey: the paper's bound."""
    return Section("Figure 5: three links and a learned model", text, {"figure5": plain(found)})


def _followed(robot: Robot, law: Controller, duration: float) -> Run:
    start = np.zeros(robot.nv)
    reference = paper_reference(robot.nv)
    return simulate(MujocoPlant(robot), law, reference, duration, PERIOD, q0=start, effort_limit=np.inf, lookahead=0.0)


def _draw(runs: Mapping[str, Mapping[str, Run]], path: Path) -> None:
    """Columns: the set-ups. Rows: angles, tracking errors, ‖z1‖² over all of the time."""
    colours = (TORQUE, ACTUAL, ERROR, REFERENCE)
    with picture(path, 11.0, 8.6) as figure:
        grid = figure.subplots(3, len(runs), squeeze=False, sharex="col", sharey="row")
        for axes, (setup, several) in zip(grid.T, runs.items(), strict=True):
            for k, ((name, run), colour) in enumerate(zip(several.items(), colours, strict=False)):
                _draw_run(axes, run, colour, name, 3.0 if k == 0 else 1.0)
            axes[0].set_title(setup, loc="left")
            axes[2].axhline(PRINTED, color=LIMIT, linewidth=0.9, linestyle=(0, (5, 3)))
            axes[2].set(yscale="log", xlabel="time [s]", xlim=(0.0, run.t[-1]))
        for axes, label in zip(grid[:, 0], ("angles [rad]", "tracking errors z1 [rad]", "‖z1‖² [rad²]"), strict=True):
            axes.set_ylabel(label)
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)


def _draw_run(axes: np.ndarray, run: Run, colour: str, name: str, width: float) -> None:
    """A column of the picture; the run of the exact model is wide, for others to lie on."""
    z1, t = metrics.error(run), run.t
    look: dict[str, Any] = {"color": colour, "linewidth": width, "alpha": 0.45 if width > 1.0 else 1.0}
    for joint, style in zip(range(run.nv), ("-", "--", ":"), strict=False):
        axes[0].plot(*thin(t, run.q[:, joint]), style, label=name if joint == 0 else None, **look)
        axes[0].plot(*thin(t, run.q_ref[:, joint]), style, color="#1d2733", linewidth=0.9, zorder=3)
        axes[1].plot(*thin(t, z1[:, joint]), style, **look)
    axes[2].plot(*thin(t, np.sum(z1 * z1, axis=-1)), **look)
