"""The doors of the package: every public function, constructor and method, with arguments that it takes."""

import dataclasses
import functools
import inspect
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import nbs_pin as nbs

RESULTS = (
    "Estimate",
    "Attack", "Certificate", "ModelErrors", "Monitored", "Training", "Proposal", "Verification", "Robot", "Reference",
    "ToolMotion", "ToolPath", "ToolErrors", "ArgumentError", "CertificateRefused", "FileFormatError", "MissingExtra",
    "NbsPinError", "NoSuchFile", "RobotError", "RobotNotFound", "SimulationDiverged", "TooLarge", "Driven", "Fault",
    "FaultReport", "Mode", "Sample", "ExcitingMotion", "ExternalTorque", "ObservedTorques", "TransientBound",
    "TransientCheck", "TransientAttack", "CampaignTable",
)  # fmt: skip
"""What functions of the package return and nobody constructs; their methods are doors all the same."""
INTERFACES = ["Controller", "MemorylessController", "DynamicsProvider", "LyapunovLaw", "ModelLaw", "Plant"]
"""Abstract classes: their methods are called on what derives from them."""
OUTSIDE = ["ArmInterface", "FrankaArm", "URArm"]
"""What reaches out of the process, to any address that it is given, and the protocol of such classes."""
INFINITE = (
    "extra_stiffness", "extra_damping", "damping_share", "damping_slope", "stiffness_range", "stiffness_rate",
    "Admissible", "convergence_time", "slope", "share", "packed", "packed_law", "lyapunov", "structure_claims",
    "excess", "curvature", "curvature_range", "curvature_rate", "half_width", "resolution", "losses",
    "held_storage",
)  # fmt: skip
"""Doors whose documented result may be infinite, or does not consist of numbers of the motion."""


@dataclass(frozen=True)
class Door:
    """A function of the package and arguments that it takes."""

    name: str
    function: Callable[..., Any]
    good: dict[str, Any]
    """Arguments by name."""
    parameters: tuple[str, ...]
    """All that can be given by name."""


class Stock:
    """Objects of a two-joint arm to call methods of, and to give as arguments; each made at its first use."""

    def __init__(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="fuzz-"))

    def __getattr__(self, name: str) -> Any:
        made = getattr(Stock, f"_{name}")(self)
        setattr(self, name, made)
        return made

    def _robot(self) -> Any:
        return nbs.load_robot("two_link")

    def _model(self) -> Any:
        return nbs.PinocchioDynamics(self.robot)

    def _law(self) -> Any:
        return nbs.NeuralBackstepping.for_robot(self.robot)

    def _adaptive(self) -> Any:
        return nbs.AdaptiveLaw(self.law, load_mass=0.5)

    def _adapted(self) -> Any:
        return nbs.simulate(self.plant, self.adaptive, self.motion, 0.02, 0.001)

    def _transient(self) -> Any:
        return nbs.transient_bound(self.adaptive, 0.5)

    def _friction(self) -> Any:
        return nbs.JointFriction([0.1, 0.1], [0.2, 0.1])

    def _observer(self) -> Any:
        return nbs.MomentumObserver(self.model)

    def _plant(self) -> Any:
        return nbs.DynamicsPlant(self.model)

    def _motion(self) -> Any:
        return nbs.Sinusoid.for_robot(self.robot)

    def _arm(self) -> Any:
        return nbs.PlantArm(self.plant, Q, real_time=False)

    def _run(self) -> Any:
        return nbs.simulate(self.plant, self.law, self.motion, 0.02, 0.001)

    def _certificate(self) -> Any:
        return nbs.certify(self.law, [5.0, 5.0])

    def _data(self) -> Any:
        return nbs.collect(self.robot, "uniform", 60)

    def _learned(self) -> Any:
        return nbs.fit(self.data, "chain", robot=self.robot, starts=1)

    def _residual(self) -> Any:
        from nbs_pin.dynamics.residual import ResidualNetwork

        return nbs.ResidualDynamics(ResidualNetwork(self.model, widths=(4,)))

    def _identified(self) -> Any:
        return nbs.identify(self.data, self.robot)

    def _tool_path(self) -> Any:
        begin = self.robot.pose(BENT, "tip")[:3, 3]
        return nbs.ToolPath.line(begin, [-0.1, 0.0, 0.05])

    def _exciting(self) -> Any:
        return nbs.exciting_motion(self.robot, duration=2.0, starts=1)

    def _tool_motion(self) -> Any:
        return nbs.tool_motion(self.robot, self.tool_path, "tip", posture=BENT)

    def _campaign(self) -> Any:
        return nbs.Campaign({"robot": "two_link", "duration": 0.02}, grid={"law": ["nbs", "pid"]})

    def path(self, name: str, write: Callable[[Path], Any]) -> Path:
        """A file, written at its first use."""
        file = self.folder / name
        if not file.exists():
            write(file)
        return file


def _write_campaign(file: Path) -> None:
    file.write_text('robot = "two_link"\nduration = 0.02\n[grid]\nlaw = ["nbs", "pid"]\n', encoding="utf-8")


def _write_tool_path(file: Path) -> None:
    np.savez(file, x=np.array([0.5, 0.6, 0.6]), y=np.zeros(3), z=np.array([0.3, 0.3, 0.2]))


@functools.cache
def stock() -> Stock:
    """The objects of this process."""
    return Stock()


_TOOL = str(Path(nbs.load_robot("three_link").urdf.path))
Z, Q, V = np.zeros(2), np.array([0.3, -0.2]), np.array([0.1, 0.4])
BENT = np.array([0.3, 1.2])
"""A posture from which the tip can move in every direction."""


def _common(s: Stock) -> dict[str, Any]:
    """Good values of arguments that mean the same at every door."""
    return {
        "robot": s.robot, "dynamics": s.model, "controller": s.law, "plant": s.plant, "reference": s.motion,
        "friction": s.friction, "run": s.run, "certificate": s.certificate, "data": s.data, "model": s.model,
        "truth": s.model, "duration": 0.01, "period": 0.001, "bandwidth": 8.0, "seed": 1, "disturbance": [5.0, 5.0],
        "q": Q, "v": V, "a": V, "tau": V, "v_r": V, "a_r": V, "q_ref": Z, "v_ref": Z, "a_ref": Z, "t": 0.5, "z": Q,
        "needed": V,
        "z1": Q, "z2": V, "dz": V, "dz1": V, "x": Q, "tau_d": V, "direction": V, "radius": 0.5, "radii": np.ones(2),
        "weights": np.ones(2), "nv": 2, "n": 2, "gain": 3.0, "rate": 2.0, "kp": 9.0, "ki": 1.0, "kd": 3.0, "limit": 5.0,
        "metric": np.eye(2), "initial": 0.5, "share": 0.3, "rows": slice(0, 10), "start": 0, "samples": 50,
        "progress": False, "folder": s.folder / "law",
    }  # fmt: skip


def _own(s: Stock) -> dict[str, dict[str, Any]]:
    """Good values at single doors, in place of the common ones; None removes one, so that its default is taken."""
    quick = {"starts": 1, "duration": 0.02, "period": 0.01, "epochs": 1, "references": [s.motion], "held_out": 0}
    row = dict.fromkeys(("q", "v", "tau", "tau_command", "disturbance", "q_ref", "v_ref", "a_ref"), np.zeros((3, 2)))
    run = {"t": np.arange(3.0), **row, "effort_limit": np.ones(2), "continuous": np.zeros(2, bool), "period": 1.0}
    single = nbs.Reference(Q, V, V)
    tensor = torch.zeros(4, 2, dtype=torch.float64)
    return {
        "AdaptiveLaw": {"law": s.law, "adapts": ["load", "rotors"], "load_mass": 1.0, "largest_rotor": 0.1},
        **{
            f"{kind}.{method}": {"memory": s.adaptive.initial_memory(Q), "reference": nbs.Reference(Q, V, V)}
            for kind in ("AdaptiveLaw", "CompiledAdaptiveLaw") for method in ("step", "recorded")
        },
        "AdaptiveLaw.estimates": {"recorded": s.adaptive.unknowns.start},
        "CompiledAdaptiveLaw.estimates": {"recorded": s.adaptive.unknowns.start},
        "AdaptiveLaw.estimate": {"believed": None},
        "plot_estimates": {"path": s.folder / "estimates.png", "run": s.adapted},
        "AnalyticDynamics": {"masses": (1.0, 1.0), "lengths": (1.0, 1.0), "gravity": 9.8},
        "AdaptiveLaw.for_robot": {"adapts": ["load", "rotors"]},
        "Admissible.told": {"units": ["N·m", "N·m"]},
        "Admissible": {"box": np.ones(2), "radius": None},
        "Dataset": {**{name: getattr(s.data, name) for name in _COLUMNS}, "robot": "arm", "about": {}},
        "Campaign": {"fixed": {"robot": "two_link"}, "samples": 2, "random": {"payload": {"from": 0, "to": 1}}},
        "Campaign.load": {"path": s.path("campaign.toml", _write_campaign)},
        "CampaignTable.column": {"name": "law"},
        "CampaignTable.worst": {"most": 1},
        "CampaignTable.write_csv": {"path": s.folder / "table.csv"},
        "CampaignTable.write_parquet": {"path": s.folder / "table.parquet"},
        "run_campaign": {"campaign": s.campaign, "folder": s.folder / "campaign", "workers": 1, "cluster": None},
        "ChangingPlant": {"first": s.plant, "changes": [(0.005, nbs.MujocoPlant(s.robot))]},
        "Damping": {"floor": np.eye(2), "gain": 0.2, "scale": np.ones(2), "ceiling": 1.0, "widths": (4,)},
        "Potential": {"stiffness": np.eye(2), "scale": np.ones(2), "widths": (4,)},
        "NeuralBackstepping": {"potential": s.law.potential, "damping": s.law.damping, "rate": np.ones(2)},
        "NeuralBackstepping.for_robot": {"gains": None},
        "NeuralBackstepping.losses": {"e": s.law.errors(Q, V, Z, Z, Z)},
        "SlotineLi.losses": {"e": s.law.errors(Q, V, Z, Z, Z)},
        "SlidingMode.losses": {"e": s.law.errors(Q, V, Z, Z, Z)},
        "CoupledDynamics": {"parameters": s.identified.parameters, "coupling": [[1.0, 0.0], [1.0, 1.0]]},
        "IdentifiedDynamics": {"parameters": s.identified.parameters},
        "IdentifiedDynamics.write_urdf": {"path": s.folder / "written.urdf"},
        "MujocoPlant.write_mjcf": {"path": s.folder / "written.xml"},
        "CoupledDynamics.write_urdf": {"path": s.folder / "coupled.urdf"},
        "LagrangianDynamics": {"network": s.learned.network},
        "ResidualDynamics": {"network": s.residual.network},
        "DriveFriction": {"viscous": Z, "coulomb": Z, "transition": 0.01, "offset": 0.1},
        "JointFriction": {"viscous": Z, "coulomb": Z, "transition": 0.01},
        "PD": {"feedforward": "gravity"},
        "PID": {"kp": np.ones(2), "effort_limit": 50.0, "continuous": np.zeros(2, bool)},
        "SlidingMode": {"switching": 1.0, "boundary": 0.1},
        "Encoders": {"step": 1e-4},
        "Encoders.of_bits": {"bits": 16},
        "Guard": {"effort_limit": [9.0, 9.0], "velocity_limit": 2.0, "lower": -1.0, "upper": 1.0, "damping": 1.0},
        "Guard.for_robot": {"torque_rate": 500.0, "certificate": None},
        "Guarded": {"law": s.law, "lookahead": 0.001, "observer": s.observer},
        "Approach": {"motion": s.motion, "length": 1.0, "coefficients": np.zeros((6, 2)), "ramp": 1.0},
        "Approach.from_state": {"motion": s.motion, "length": None},
        "PlantArm": {"real_time": False, "disturbance": None},
        "drive": {"arm": s.arm, "law": s.law, "motion": s.motion, "guard": None},
        "Hold": {"q": Q},
        "MinimumJerk": {"waypoints": np.array([[0.0, 0.0], [1.0, 1.0]]), "times": np.array([0.0, 2.0])},
        "Sampled": {"t": np.arange(5.0), "q": np.zeros((5, 2))},
        "Sinusoid": {"amplitude": Q, "frequency": 2.0, "phase": 0.1, "offset": 0.0},
        "Sinusoid.for_robot": {"frequency": 1.0, "amplitude": 0.5},
        "ConstantTorque": {"torque": Q},
        "SinusoidalTorque": {"amplitude": Q, "frequency": 2.0},
        "SquareWave": {"amplitude": Q, "frequency": 2.0},
        "TorqueNoise": {"std": 1.0, "period": 0.01},
        "Payload": {"mass": 1.0, "radius": 0.1},
        "Uncertainty": {"inertia": 0.1, "payload": nbs.Payload(1.0)},
        "Uncertainty.errors": {"model": s.robot.model},
        "MomentumObserver.step": {"memory": s.observer.initial(Q, V)},
        "MomentumObserver.estimate": {"t": np.arange(3.0), **dict.fromkeys(("q", "v", "tau"), np.zeros((3, 2)))},
        "ObservedTorques.save": {"path": s.folder / "observed.csv"},
        "Noise": {"encoder": 1e-4, "torque": 0.1},
        "TorqueAware": {"limit": 5.0, "rate": 0.02},
        "TimeOutside": {"threshold": 0.01, "pull": 0.1},
        "TorqueAware.__call__": {"z1": tensor, "dz1": tensor, "tau": tensor},
        "TimeOutside.__call__": {"z1": tensor, "dz1": tensor, "tau": tensor},
        "Run": {**run, "joint_names": ("a", "b")},
        "Run.save": {"path": s.folder / "out.npz"},
        "Run.load": {"path": s.path("run.npz", s.run.save)},
        "Watch": {"encoders": None},
        "Watch.step": {"memory": None, "t": 0.1, "reference": single, "tau_command": V},
        "Certificate.storage_bound": {"t": np.linspace(0.0, 1.0, 3)},
        "Dataset.thinned": {"most": 20},
        "Dataset.save": {"path": s.folder / "data.npz"},
        "attack": {"rounds": 0, "starts": 1, "effort_limit": np.inf},
        "certified_margins": {"acceleration": 2.0, "velocity": 1.0},
        "certify": {"duration": 0.5, "q0": Q, "v0": Z},
        "collect": {"recipe": "uniform", "samples": 20, "friction": False, "duration": 3.0, "reference": None},
        "compare": {"samples": 20, "motions": 1, "run": None, "friction": None},
        "about": {"path": s.path("law.nbs", functools.partial(nbs.save, s.law))},
        "load": {"path": s.path("law.nbs", functools.partial(nbs.save, s.law)), "robot": None},
        "save": {"path": s.folder / "saved.nbs"},
        "exciting_motion": {"duration": 2.0, "band": 1.0, "starts": 1},
        "ExcitingMotion.save": {"path": s.folder / "exciting.csv", "period": 0.01},
        "fit": {"model": "chain", "friction": False, "held_out": None, "starts": 1},
        "identify": {"friction": False, "rotor_inertia": False},
        "load_dataset": {"path": s.path("data.npz", s.data.save)},
        "load_log": {"path": s.path("data.npz", s.data.save)},
        "load_reference": {"path": s.path("run.npz", s.run.save), "joint_names": s.robot.joint_names},
        "load_robot": {"name_or_path": "two_link", "gravity": 9.81, "payload": 1.0, "base_rpy": [0.1, 0.2, 0.3]},
        "Robot.with_armature": {"armature": [0.1, 0.2]},
        "Robot.with_friction": {"coulomb": 0.5, "viscous": [0.1, 0.2]},
        "Robot.with_payload": {"frame": "tip", "mass": 1.0, "com": [0.0, 0.0, 0.1], "inertia": 0.0},
        "Robot.with_tool": {"file": _TOOL, "frame": "tip", "xyz": [0.0, 0.0, 0.1], "rpy": [0.0, 0.0, 0.1]},
        "monitor": {"start": 0},
        "paper_controller": {"m": 0.001},
        "plot_tracking": {"path": s.folder / "plot.png", "external": s.observer.observe(s.run)},
        "propose": {"error": 0.1, "disturbance": [1.0, 1.0], "duration": 0.5, "periods": (0.01,)},
        "export_run": {"path": s.folder / "exported.csv", "monitored": None},
        "import_run": {"path": s.path("imported.csv", functools.partial(nbs.export_run, s.run))},
        "Monitored.save": {"path": s.folder / "monitored.csv"},
        "replay": {"path": s.folder / "replay.html"},
        "tool_motion": {"path": s.tool_path, "frame": "tip", "posture": BENT, "duration": 5.0},
        "tool_posture": {"frame": "tip"},
        "tool_errors": {"frame": "tip"},
        "load_tool_path": {"path": s.path("tool.npz", _write_tool_path)},
        "ToolPath.circle": {"start": np.array([0.5, 0.0, 0.3]), "radius": 0.1},
        "ToolPath.line": {"start": np.array([0.5, 0.0, 0.3]), "displacement": np.array([0.1, 0.0, 0.0])},
        "ToolPath.through": {"positions": np.array([[0.5, 0.0, 0.3], [0.6, 0.0, 0.3], [0.6, 0.0, 0.2]])},
        "ToolPath.poses": {"s": 0.5, "orientation": np.eye(3)},
        "ToolPath.travelled": {"s": 0.5},
        "Robot.frame_id": {"frame": "tip"},
        "Robot.supporting": {"frame": "tip"},
        "Robot.pose": {"frame": "tip"},
        "Robot.jacobian": {"frame": "tip"},
        "Margins": {"position": 0.1, "velocity": 0.1, "effort": 1.0},
        "simulate": {"disturbance": None, "q0": Q, "v0": Z, "workers": 1},
        "stream": {"disturbance": None, "q0": Q, "v0": Z, "block": 5},
        "squared_error": {"tau": V},
        "transient_attack": {"bound": s.transient, "duration": 0.02, "period": 0.001, "runs": 10},
        "transient_bound": {"law": s.adaptive, "load_mass": 0.5, "load_radius": 0.0, "start": 0.0, "q0": Q, "v0": Z},
        "train": {**quick, "disturbance": None, "cost": nbs.squared_error},
        "verify": {"path": s.path("certificate.json", functools.partial(nbs.write_certificate, s.certificate))},
        "write_certificate": {"path": s.folder / "certificate-out.json"},
        "metrics.steady_error": {"last": 0.3, "shift": 0},
        "metrics.summary": {"after": 0.01},
        "metrics.rms_error": {"after": 0.0},
    }  # fmt: skip


def _subjects(s: Stock) -> dict[str, Any]:
    """An object of each class to call methods of."""
    found = [
        nbs.Admissible(box=np.ones(2)), nbs.AnalyticDynamics(), nbs.ComputedTorque.for_robot(s.robot), s.certificate,
        s.transient,
        nbs.ConstantTorque([1.0, 2.0]), s.law.damping, s.data, s.plant, nbs.Encoders(1e-4), nbs.Hold(Q), s.identified,
        s.friction, s.learned, nbs.MinimumJerk([[0.0, 0.0], [1.0, 1.0]], [0.0, 2.0]), nbs.MujocoPlant(s.robot), s.law,
        s.adaptive, s.adaptive.estimate(), nbs.PD.for_robot(s.robot), nbs.PID.for_robot(s.robot), s.model,
        s.law.potential, s.residual, s.robot, s.run,
        nbs.Sampled(np.arange(5.0), np.zeros((5, 2))), s.motion, nbs.SinusoidalTorque([1.0, 2.0], 2.0),
        nbs.SlidingMode.for_robot(s.robot), nbs.SlotineLi.for_robot(s.robot), nbs.SquareWave([1.0, 2.0], 2.0),
        nbs.TimeOutside(), nbs.TorqueAware.for_robot(s.robot), nbs.TorqueNoise(1.0, 0.01), nbs.Uncertainty(0.1),
        nbs.Watch(s.certificate), s.exciting, s.tool_path, s.tool_motion, nbs.Margins(0.1),
        nbs.tool_errors(s.run, s.robot, "tip"), nbs.ChangingPlant(s.plant, [(0.005, nbs.MujocoPlant(s.robot))]),
        nbs.tool_errors(s.run, s.robot, "tip"), s.observer, s.observer.observe(s.run),
        s.campaign, nbs.run_campaign(s.campaign, s.folder / "campaign"),
    ]  # fmt: skip
    return {type(x).__name__: x for x in found} | {
        "CompiledController": s.law.compile(),
        "CompiledPID": nbs.PID.for_robot(s.robot).compile(),
        "CompiledAdaptiveLaw": s.adaptive.compile(),
    }


def doors() -> list[Door]:
    """All doors, in a fixed order."""
    s = stock()
    subjects, found = _subjects(s), []
    for name in sorted(public_names()):
        thing = getattr(nbs, name)
        if name == "metrics":
            functions = [f for f in vars(thing).values() if inspect.isfunction(f) and f.__module__ == thing.__name__]
            found += [(f"metrics.{f.__name__}", f) for f in functions if not f.__name__.startswith("_")]
        elif inspect.isclass(thing):
            found += [] if name in (*RESULTS, *INTERFACES, *OUTSIDE) else [(name, thing)]
            found += [(f"{name}.{m}", getattr(subjects.get(name, thing), m)) for m in _methods(thing, subjects)]
        elif callable(thing):
            found.append((name, thing))
    for name in ("CompiledController", "CompiledPID", "CompiledAdaptiveLaw"):
        found += [(f"{name}.{m}", getattr(subjects[name], m)) for m in _methods(type(subjects[name]), {name: 0})]
    common, own = _common(s), _own(s)
    memory = subjects["PID"].initial_memory(Q)
    own |= {f"{name}.step": {"reference": nbs.Reference(Q, V, V), "memory": None} for name in _LAWS}
    own |= {f"{name}.step": {"reference": nbs.Reference(Q, V, V), "memory": memory} for name in ("PID", "CompiledPID")}
    return [_door(name, function, common, own.get(name, {})) for name, function in found]


def public_names() -> list[str]:
    """The names of `__init__.pyi`."""
    return [name for name in dir(nbs) if not name.startswith("_")]


def _methods(kind: type, subjects: dict[str, Any]) -> list[str]:
    """Public methods that package code defines, class methods alone where there is no object to call others of."""
    found = []
    for name in sorted(dir(kind)):
        raw = inspect.getattr_static(kind, name)
        is_static = isinstance(raw, classmethod | staticmethod)
        function = raw.__func__ if is_static else raw
        ours = inspect.isfunction(function) and function.__module__.startswith("nbs_pin")
        if ours and (not name.startswith("_") or name == "__call__") and (is_static or kind.__name__ in subjects):
            found.append(name)
    return found


def _door(name: str, function: Callable[..., Any], common: dict[str, Any], own: dict[str, Any]) -> Door:
    taken, good = [], {}
    for parameter in inspect.signature(function).parameters.values():
        if parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
            taken += [key for key in own if key not in taken]
            good |= {key: value for key, value in own.items() if key not in good}
            continue
        taken.append(parameter.name)
        if parameter.name in own:
            value = own[parameter.name]
            if value is not None or parameter.default is parameter.empty:
                good[parameter.name] = value
        elif parameter.name in common and (parameter.default is parameter.empty or name in _FULL):
            good[parameter.name] = common[parameter.name]
        elif parameter.default is parameter.empty and parameter.name not in own:
            default = _FALLBACK.get(parameter.name, common.get(parameter.name, dataclasses.MISSING))
            if default is dataclasses.MISSING:
                raise LookupError(
                    f"door {name} has no good value for {parameter.name}; add one to tools/fuzz/doors.py."
                )
            good[parameter.name] = default
    return Door(name, function, good, tuple(taken))


_COLUMNS = ("q", "v", "a", "tau", "t", "trajectory", "parents", "prismatic")
_LAWS = ("ComputedTorque", "NeuralBackstepping", "PD", "SlidingMode", "SlotineLi", "CompiledController")
_FULL = (
    "simulate",
    "stream",
    "certify",
    "check_reference",
    "collect",
    "attack",
    "train",
    "NeuralBackstepping.for_robot",
)
"""Doors that get the common values of optional arguments too."""
_FALLBACK = {"memory": None, "recorded": np.zeros((3, 2)), "reference": nbs.Reference(Q, V, V)}
