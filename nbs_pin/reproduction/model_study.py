"""Learned models held against the truth: from clean data, from noisy data, and what structure is worth."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from nbs_pin.reports.markdown import Section
from nbs_pin.reproduction.model_clean import clean_section, clean_trials
from nbs_pin.reproduction.model_noise import noise_section, noise_trials
from nbs_pin.reproduction.model_structure import STRUCTURES, structure_section, structure_trials
from nbs_pin.reproduction.model_trials import FRESH_SAMPLES

FILES = (
    "models_clean.csv",
    "models_noise.csv",
    "models_noise_excited.png",
    "models_noise_uniform.png",
    "models_structure.csv",
    "models_structure.png",
)
"""What `reproduce_models` writes."""


@dataclass(frozen=True)
class Scale:
    """How much of everything."""

    fresh: int = FRESH_SAMPLES
    """States that a model is judged on, uniform ones and as many on trajectories."""
    seeds: int = 5
    """Of data and first parameters, of clean data and structures."""
    clean_arms: tuple[str, ...] = ("three_link", "ur5", "panda", "xarm7")
    clean_samples: int = 1_500
    noise_arms: tuple[str, ...] = ("three_link", "ur5", "panda")
    noise_seeds: int = 5
    noise_samples: tuple[int, ...] = (300, 1_000, 3_000, 10_000)
    mlp: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    """Settings of `fit_mlp`."""
    structure_samples: tuple[int, ...] = (1_000, 10_000)
    structures: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: STRUCTURES)
    """Models, and the settings of `fit` that bound their time."""


def reproduce_models(folder: Path, seed: int = 0, progress: bool = False, scale: Scale | None = None) -> list[Section]:
    """Fits and judges everything, writes `FILES` into the folder and returns the sections of the page.

    seed: the first of the seeds. scale: None takes `Scale()`, about an hour on two cores.
    Raises OSError when a file cannot be written and KeyboardInterrupt on Ctrl-C.
    """
    scale = scale or Scale()
    seeds = range(seed, seed + scale.seeds)
    clean = clean_trials(scale.clean_arms, scale.clean_samples, seeds, scale.fresh, progress)
    sections = [clean_section(clean, folder)]
    noisy_seeds = range(seed, seed + scale.noise_seeds)
    noisy = noise_trials(scale.noise_arms, scale.noise_samples, noisy_seeds, scale.fresh, progress, scale.mlp)
    sections.append(noise_section(noisy, folder))
    structured = structure_trials(scale.structures, scale.structure_samples, seeds, scale.fresh, progress)
    sections.append(structure_section(structured, folder))
    return sections
