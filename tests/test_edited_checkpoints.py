"""Checkpoints edited by hand and sealed again: what they promise is refused, labelled down, or still true."""

import json
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch

from nbs_pin.base.archives import read_archive, write_archive
from nbs_pin.base.claims import weakest
from nbs_pin.base.exceptions import NbsPinError
from nbs_pin.certificates.structure import check_structure
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping, paper_controller
from nbs_pin.dynamics.cholesky import CholeskyNetwork
from nbs_pin.dynamics.lagrangian import LagrangianDynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.robots.robot import load_robot
from nbs_pin.storage.checkpoints import FORMAT, load, save

ROBOT = load_robot("two_link")


def resealed(path, edit) -> Path:
    """The checkpoint with its controller.json and tensors edited, under a seal that fits."""
    entries = read_archive(path, FORMAT)
    document = json.loads(entries["controller.json"])
    tensors = safetensors.torch.load(entries["controller.safetensors"])
    edit(document, tensors)
    entries["controller.json"] = json.dumps(document).encode()
    entries["controller.safetensors"] = safetensors.torch.save(tensors)
    edited = path.with_name("edited.nbs")
    write_archive(edited, FORMAT, entries)
    return edited


def factor(x, *names):
    """Every tensor whose name ends in one of these, multiplied."""

    def edit(document, tensors):
        chosen = [name for name in tensors if name.endswith(names)]
        assert chosen
        for name in chosen:
            tensors[name] = x * tensors[name]

    return edit


def entry(name, index, x):
    def edit(document, tensors):
        tensors[name] = tensors[name].clone()
        tensors[name][index] = x

    return edit


def setting(x, *path):
    def edit(document, tensors):
        description = document["controller"]
        for key in path[:-1]:
            description = description[key]
        assert path[-1] in description
        description[path[-1]] = x

    return edit


S, D0, RATE = "potential.stiffness.nominal", "damping.floor.nominal", "rate.nominal"
EDITS = {  # with those that test_checkpoints.py knows the words of
    "S not symmetric": ("smooth", entry(S, (0, 1), 1.0)),
    "S indefinite": ("smooth", entry(S, (1, 1), -1.0)),
    "S not a number": ("smooth", entry(S, (0, 0), np.nan)),
    "D₀ negative": ("smooth", factor(-1.0, D0)),
    "D₀ zero": ("smooth", factor(0.0, D0)),
    "D₀ not symmetric": ("smooth", entry(D0, (1, 0), 3.0)),
    "D₀ infinite": ("smooth", entry(D0, (0, 0), np.inf)),
    "Λ negative": ("smooth", entry(RATE, 1, -1.0)),
    "Λ zero": ("smooth", factor(0.0, RATE)),
    "Λ not a number": ("smooth", entry(RATE, 0, np.nan)),
    "ω not a number": ("smooth", setting(float("nan"), "inertial_rate")),
    "m zero in the paper's damping": ("m", setting(0.0, "damping", "m")),
    "m negative": ("m", setting(-1e-3, "damping", "m")),
    "scale R negative": ("smooth", factor(-1.0, "potential.scale")),
    "scale R zero": ("smooth", factor(0.0, "potential.scale")),
    "a bias in the paper's ψ": ("paper", lambda _, t: t.update({"potential.network.b2": torch.ones(32).double()})),
    "the paper's form with another's biases": ("smooth", setting("paper", "potential", "form")),
    "Squareplus in the paper's ψ": ("paper", setting({"kind": "Squareplus", "b": 1.0}, "potential", "activation")),
    "SmoothedReLU with d < 0": ("paper", setting(-0.01, "potential", "activation", "d")),
    "an activation that is none": ("smooth", setting({"kind": "ReLU"}, "potential", "activation")),
    "a weight of T not a number": ("smooth", entry("damping.lower.w1", (3, 4), np.nan)),
    "ε of a learned mass zero": ("learned", factor(0.0, "scales.epsilon")),
    "ε of a learned mass negative": ("learned", factor(-1.0, "scales.epsilon")),
    "another arm": ("smooth", setting("panda", "dynamics", "robot", "source")),
}


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory) -> dict[str, Path]:
    """Sound laws in files: both forms of ψ, the paper's damping, a learned model."""
    folder = tmp_path_factory.mktemp("sound")
    laws = {form: NeuralBackstepping.for_robot(ROBOT, potential=form) for form in ("smooth", "paper")}
    laws["m"] = paper_controller(PinocchioDynamics(ROBOT))
    learned = LagrangianDynamics(CholeskyNetwork([False] * 2, widths=(8,)), robot=ROBOT)
    laws["learned"] = NeuralBackstepping.for_robot(ROBOT, learned)
    for name, controller in laws.items():
        save(controller, folder / f"{name}.nbs")
    return {name: folder / f"{name}.nbs" for name in laws}


@pytest.mark.parametrize("name", ["smooth", "paper", "learned"])
def test_a_file_sealed_again_without_an_edit_is_as_sound_as_before(name, checkpoints):
    assert outcome(resealed(checkpoints[name], lambda *_: None)) == "PROVED"


@pytest.mark.parametrize("edit", EDITS)
def test_an_edited_checkpoint_is_refused_or_labelled_down(edit, checkpoints):
    """By `load`, by the structure's check, or by a label; each error is one sentence of the package's own."""
    name, change = EDITS[edit]
    said = outcome(resealed(checkpoints[name], change))
    assert said not in ("PROVED", "VERIFIED", "PROBABILISTIC")
    assert len(said.splitlines()) == 1


def outcome(path) -> str:
    """The weakest label of the file's claims, or the error that refused it."""
    try:
        return str(weakest(*(claim.label for claim in check_structure(load(path)).claims)))
    except NbsPinError as error:
        return str(error)


@pytest.mark.parametrize("form", ["smooth", "paper"])
def test_no_edit_of_the_parameters_behind_wy_makes_a_weight_negative(form, checkpoints):
    """W^(y) goes through a function that has no negative values: an edit is kept, and its claims are true."""
    wild = [f"potential.network.wy{k}" for k in (1, 2, 3)]
    edited = load(resealed(checkpoints[form], factor(-7.0, *wild)))
    convex = next(claim for claim in check_structure(edited).claims if claim.name == "ψ convex")
    layers = edited.potential.network.layers(numpy=True)
    least = min(float(layer.wy.min()) for layer in layers if layer.wy is not None)
    assert least >= 0.0
    assert convex.value <= least
    x, y = np.random.default_rng(0).normal(size=(2, 500, 2))
    middle, one, other = (edited.potential.terms(z, 0.0 * z)[0] for z in (0.5 * (x + y), x, y))
    assert (middle <= 0.5 * (one + other) + 1e-9 * (1.0 + abs(one) + abs(other))).all()
