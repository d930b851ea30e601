"""The plan of a campaign: what its trials have in common, what varies on a grid and what is drawn."""

import inspect
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from math import isfinite, prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.base.arguments import SEED, checked, count, mapping, readable
from nbs_pin.base.checks import told
from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.base.shown import Shown
from nbs_pin.base.units import counted
from nbs_pin.campaigns.variables import VARIABLES, Span, check_names, drawn_from, values_of
from nbs_pin.robots.robot import load_robot

MOST_TRIALS = 100_000
_COUNTS = {"samples": count(1, MOST_TRIALS), "seed": SEED, "keep_runs": count(0, 10_000, of="runs")}
_TABLES = ("grid", "random", "arm")


class Trial(NamedTuple):
    """One closed-loop run of a campaign; it depends on the campaign and its own number alone.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.Campaign({"robot": "two_link"}, grid={"law": ["nbs", "pid"]}).trials[1].values["law"]
        'pid'
    """

    number: int
    """Which one of the campaign."""
    sample: int
    """Which draw it has of what is random."""
    seed: int
    """Seed of the campaign."""
    values: dict[str, Any]
    """Every variable by name."""
    arm: dict[str, Any]
    """Arguments of `load_robot`."""


@dataclass(frozen=True, eq=False, repr=False)
class Campaign(Shown):
    """Many closed-loop runs: every combination of the grid, each with every sample of what is random.

    The variables are robot, law, bandwidth, law_seed, reference, frequency, duration, period, start_error,
    start_spread, disturbance, payload, inertia_error, friction, unknown_viscous, unknown_coulomb, effort_share, plant,
    integrator and plant_step (docs/howto/many-runs.md).

    Args:
        fixed: Variables that have one value in all trials.
        grid: Variables with a list of values.
        random: Variables that are drawn, from a list or from {"from": least, "to": most}.
        arm: Arguments of `load_robot` for every arm.
        samples: How many draws there are of what is random.
        seed: Of the draws. A draw depends on the seed, the number of the sample and the name of the variable.
        keep_runs: How many runs are kept, those with the largest errors.

    Raises:
        ArgumentError: For an unknown variable, with the nearest one, or a value that does not fit.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.Campaign({"robot": "panda"}, grid={"law": ["nbs", "pid"]}, random={"payload": {"from": 0, "to": 2}},
        ...     samples=100)
        Campaign(200 trials, grid of law, random payload)
    """

    fixed: Mapping[str, Any]
    grid: Mapping[str, Any] = field(default_factory=dict)
    random: Mapping[str, Any] = field(default_factory=dict)
    arm: Mapping[str, Any] = field(default_factory=dict)
    samples: int = 1
    seed: int = 0
    keep_runs: int = 1

    def __post_init__(self) -> None:
        table = {
            **mapping("Campaign: fixed", self.fixed),
            **{name: getattr(self, name) for name in (*_COUNTS, *_TABLES)},
        }
        for name, value in _checked("Campaign: ", table).items():
            object.__setattr__(self, name, value)

    @classmethod
    @checked(path=readable)
    def load(cls, path: str | Path) -> "Campaign":
        """The campaign in a TOML file: fixed variables and counts, then [grid], [random] and [arm].

        Robots, laws and references that are files beside it are found there.

        Raises:
            FileFormatError: If it is no TOML, or a key or value does not fit: names the file and the key.
        """
        try:
            table = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
            raise FileFormatError(f"{path}: cannot be read as TOML ({error!s:.200}); correct it.") from error
        try:
            fields = _checked(f"{path}: ", table)
        except ArgumentError as error:
            raise FileFormatError(str(error)) from error
        for name in ("fixed", "grid", "random"):
            fields[name] = {key: _beside(Path(path).parent, key, value) for key, value in fields[name].items()}
        return cls(**fields)

    @cached_property
    def trials(self) -> tuple[Trial, ...]:
        """All trials, sample by sample."""
        usual = {name: variable.usual for name, variable in VARIABLES.items()} | dict(self.fixed)
        found: list[Trial] = []
        for sample in range(self.samples):
            drawn = {name: _draw(self.seed, sample, name, source) for name, source in self.random.items()}
            for combined in product(*self.grid.values()):
                values = usual | drawn | dict(zip(self.grid, combined, strict=True))
                found.append(Trial(len(found), sample, self.seed, values, dict(self.arm)))
        return tuple(found)

    @property
    def stated(self) -> tuple[str, ...]:
        """The variables that it names, and the law, in the order of the columns of its table."""
        named = {*self.fixed, *self.grid, *self.random, "law"}
        return tuple(name for name in VARIABLES if name in named)

    @property
    def plan(self) -> dict[str, Any]:
        """All that it states, as JSON can store it."""
        spans = {name: x._asdict() if isinstance(x, Span) else list(x) for name, x in self.random.items()}
        grid = {name: list(values) for name, values in self.grid.items()}
        tables = {"fixed": dict(self.fixed), "grid": grid, "random": spans, "arm": _stored(self.arm)}
        return {**tables, "samples": self.samples, "seed": self.seed}

    def _facts(self) -> Iterable[str]:
        yield counted(self.samples * prod(len(values) for values in self.grid.values()), "trial")
        if self.grid:
            yield f"grid of {', '.join(self.grid)}"
        if self.random:
            yield f"random {', '.join(self.random)}"


def _checked(where: str, table: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a campaign from the table of a file, in which fixed variables stand beside the counts."""
    names = (*VARIABLES, *_COUNTS, *_TABLES)
    check_names(f"{where}it" if where.startswith("Campaign") else where.removesuffix(": "), table, names)
    fixed = {name: VARIABLES[name].check(f"{where}{name}", table[name]) for name in VARIABLES if name in table}
    counts = {name: check(f"{where}{name}", table[name]) for name, check in _COUNTS.items() if name in table}
    tables = {name: mapping(f"{where}{name}", table.get(name, {})) for name in _TABLES}
    for name in ("grid", "random"):
        check_names(f"{where}{name}", tables[name], list(VARIABLES))
    check_names(f"{where}arm", tables["arm"], list(inspect.signature(load_robot).parameters)[1:])
    grid = {name: values_of(f"{where}grid", name, given) for name, given in tables["grid"].items()}
    random = {name: drawn_from(f"{where}random", name, given) for name, given in tables["random"].items()}
    for name in VARIABLES:
        if (name in fixed) + (name in grid) + (name in random) > 1:
            raise ArgumentError(f"{where}{name} is given twice, fixed, in grid or in random; give it once.")
    if "robot" not in {**fixed, **grid, **random}:
        raise ArgumentError(f'{where}robot is missing; name an arm, such as robot = "panda".')
    trials = counts.get("samples", 1) * prod(len(values) for values in grid.values())
    if trials > MOST_TRIALS:
        raise ArgumentError(f"{where}{trials} trials are asked for, at most {MOST_TRIALS} are taken; ask for fewer.")
    return {"fixed": fixed, "grid": grid, "random": random, "arm": _plain(f"{where}arm", tables["arm"]), **counts}


def _plain(where: str, table: Mapping[str, Any]) -> dict[str, Any]:
    """The table, if JSON can store it."""

    def is_plain(x: Any) -> bool:
        if isinstance(x, Mapping):
            return all(isinstance(key, str) and is_plain(value) for key, value in x.items())
        return all(map(is_plain, x)) if isinstance(x, list | tuple) else isinstance(x, str | bool | int | float)

    for name, value in table.items():
        if not is_plain(value):
            raise ArgumentError(f"{where}.{name} is {told(value)}; give numbers, texts, lists and tables.")
    return dict(table)


def _stored(x: Any) -> Any:
    """The arguments of an arm with words for numbers that are not finite, which JSON does not have."""
    if isinstance(x, Mapping):
        return {key: _stored(value) for key, value in x.items()}
    if isinstance(x, list | tuple):
        return [_stored(value) for value in x]
    return str(x) if isinstance(x, float) and not isfinite(x) else x


def _beside(folder: Path, name: str, value: Any) -> Any:
    """The value, with files beside the campaign's by their whole path."""
    if isinstance(value, tuple) and not isinstance(value, Span):
        return tuple(_beside(folder, name, one) for one in value)
    is_file = name in ("robot", "law", "reference") and Path(value).suffix and (folder / value).is_file()
    return str((folder / value).resolve()) if is_file else value


def _draw(seed: int, sample: int, name: str, source: Any) -> Any:
    """A value of the variable, which depends on these alone."""
    share = float(generator(seed, sample, name).random())
    if isinstance(source, Span):
        return VARIABLES[name].drawn(source, share)
    return source[int(share * len(source))]


def generator(seed: int, sample: int, name: str) -> np.random.Generator:
    """Random numbers of one purpose in one sample."""
    return np.random.default_rng((seed, sample, *name.encode()))
