"""`verify`: a certificate file checked again by an independent program (docs/certificates.md §11).

Nothing here comes from the code that made the file: no solver, no eigenvalues, no comparison in floating point. Numbers
of the file are taken as exact, and each inequality is decided in ball arithmetic, where it is true only if it is
certain. Section signs are those of docs/certificates.md.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.verification.balls import Balls, arb, balls, certain, ctx, inverse, positive_definite, skew
from nbs_pin.verification.document import Arm, check_arm, read_document, unit
from nbs_pin.verification.stated import FALSE, OPEN, TAKEN, Check, decided, stated
from nbs_pin.verification.trees import Link, always_heavy, differences, stated_tree, still_joints, urdf_tree

BITS = 192
"""Precision of the balls."""


@dataclass(frozen=True)
class Verification:
    """What a certificate file says that was checked again, and what was not.

    Example:
        >>> import tempfile
        >>> import nbs_pin as nbs
        >>> bound = nbs.certify(nbs.NeuralBackstepping.for_robot(nbs.load_robot("two_link")), [5.0, 5.0])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     found = nbs.verify(nbs.write_certificate(bound, f"{folder}/certificate.json"))
        >>> found.label, found.confirmed, {check.status for check in found.checks} >= {"re-verified"}
        ('PROVED', True, True)
    """

    label: str
    """The label of the bounds in the file."""
    checks: tuple[Check, ...]

    @property
    def confirmed(self) -> bool:
        """Whether the bounds are PROVED and everything PROVED was re-verified, given what is taken as stated."""
        return self.label == "PROVED" and not {check.status for check in self.checks} & {OPEN, FALSE}


def verify(path: str | Path, *, urdf: str | Path | None = None, robot: Arm | None = None) -> Verification:
    """Check a certificate file again, in ball arithmetic and without the code that made it (docs/certificates.md §11).

    Args:
        path: A file that `nbs.write_certificate` or `nbs-pin certify --json` wrote.
        urdf: The arm's URDF. None takes the file that the certificate names, if it is there.
        robot: The arm as `load_robot` gives it, which must be the one that was certified: the same links, limits and
            gravity (`Robot.sha256`), and the same joints locked.

    Raises:
        FileNotFoundError: If there is no such file.
        FileFormatError: If it is no certificate, or the URDF or the robot is not that of its arm.
        MissingExtra: If the extra `verify` is not installed.

    Example:
        >>> import tempfile
        >>> import nbs_pin as nbs
        >>> bound = nbs.certify(nbs.SlotineLi.for_robot(nbs.load_robot("two_link")), [5.0, 5.0])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     nbs.verify(nbs.write_certificate(bound, f"{folder}/certificate.json")).confirmed
        True
    """
    for name, given in (("path", path), ("urdf", urdf)):
        if (given is not None or name == "path") and not isinstance(given, str | Path):
            raise ArgumentError(f"verify: {name} is a {type(given).__name__}; give the path of a file.")
    if robot is not None and not all(hasattr(robot, name) for name in ("name", "sha256", "joint_names")):
        raise ArgumentError(f"verify: robot is a {type(robot).__name__}; give an arm, as load_robot returns it.")
    document = read_document(Path(path))
    if robot is not None:
        check_arm(Path(path), document["arm"], robot)
    with ctx.workprec(BITS):
        tree, checks = _arm(document["arm"], urdf)
        checks += _inertias(document, tree)
        for part in (_constants, _levels, _errors, stated):
            checks += part(document)
    return Verification(document["label"], tuple(checks))


def _arm(arm: dict[str, Any] | None, urdf: str | Path | None) -> tuple[list[Link], list[Check]]:
    """The tree of the URDF, or else of the file, and whether the two are the same."""
    if arm is None:
        return [], [Check("inertia", OPEN, "the model is no rigid tree")]
    path, given, name = Path(urdf or arm["urdf"] or ""), stated_tree(arm["joints"]), "the tree is the arm's"
    if urdf is None and not (path.suffix == ".urdf" and path.is_file()):
        return given, [
            Check(
                name, OPEN, "the file names no URDF that is here; give it, or the arm.urdf beside the file, with --urdf"
            )
        ]
    read = urdf_tree(path, arm["joints"])
    faults, still = differences(given, read), still_joints(path, arm["joints"])
    locked = [Check("joints held at zero", TAKEN, f"{', '.join(still)}, which the file does not name")] if still else []
    because = f"differs in {', '.join(faults)}" if faults else f"read from {path}"
    return read, [decided(name, not faults, because), *locked]


def _inertias(document: dict[str, Any], tree: list[Link]) -> Iterator[Check]:
    """The bounds of M by their multipliers, 1/κ and 1/ν with them (§6), and M ≻ 0, without which V bounds nothing."""
    is_positive, is_open = bool(tree) and always_heavy(tree), False
    kappa, nu, n = document["constants"]["kappa"], document["constants"]["nu"], len(document["law"]["rate"])
    for line, used in zip(document["inertia"], (kappa, nu, None, None), strict=True):
        name, least = f"{line['side']} λ(W^-½MW^-½), W = {line['weight']}", line["side"] == "least"
        if not (line["value"] or used):
            continue  # no bound is claimed
        if line["label"] != "PROVED" or line["multipliers"] is None or line["value"] is None or not tree:
            if used or line["label"] == "PROVED":
                is_open = True
                yield Check(name, OPEN, f"{line['label']}: {line['because']}")
            continue
        bound = arb(line["value"])
        if used:
            bound = bound.max(1 / arb(used)) if least else bound.min(1 / arb(used))
        weight = balls(document["law"]["floor"] if line["weight"] == "D0" else np.eye(n))
        form = energy_form(tree, bound * weight, 1 if least else -1, line["multipliers"])
        true = form is not None and positive_definite(form)
        is_positive = is_positive or (true and least and bound > 0)
        yield decided(name, true, f"{len(line['multipliers'])} multipliers, §6")
    if tree and not is_positive and is_open:
        yield Check("M ≻ 0 in every pose", OPEN, "no multipliers show it")
    elif tree:
        because = "by its least eigenvalue or the inertia of each body" if is_positive else "V ≥ Φ does not follow"
        yield decided("M ≻ 0 in every pose", is_positive, because)


def energy_form(tree: list[Link], weight: Balls, sign: int, multipliers: Sequence[float]) -> Balls | None:
    """sign·(2T − q̇ᵀWq̇) + Σ h·(forms that are zero, or ≤ 0 if h ≥ 0), in the coordinates of §6.

    None for a multiplier that is missing, left over or negative where it must not be.
    """
    alone: list[bool] = []  # whether M does not depend on the joint
    for link in tree:
        alone.append(link.parent < 0 or (link.slides and alone[link.parent] and tree[link.parent].slides))
    free = [_free(link, skip) for link, skip in zip(tree, alone, strict=True)]
    ends = np.cumsum([len(rows) for rows in free])
    total, h = balls(np.zeros((ends[-1], ends[-1]))), list(map(arb, multipliers))
    twists: list[Balls] = []
    for link, rows, end, skip in zip(tree, free, ends, alone, strict=True):
        above = twists[link.parent] if link.parent >= 0 else balls(np.zeros((6, ends[-1])))
        turn = link.rotation.T
        seen = np.concatenate([turn @ (above[:3] - skew(link.position) @ above[3:]), turn @ above[3:]])
        own = seen.copy()
        own[rows[:-1]] = 0 * own[rows[:-1]]
        own[rows, np.arange(end - len(rows), end)] += 1
        twists.append(own)
        speed, spin = own[:3] - skew(link.centre) @ own[3:], own[3:]
        total += sign * (link.mass * speed.T @ speed + spin.T @ link.inertia @ spin)
        total[end - 1, end - 1] += sign * link.armature
        count = 0 if skip else (4 if not link.slides else 1 if link.travel is None else 2)
        if len(h) < count or (count == 2 and not h[1] >= 0):
            return None
        if count == 4:
            total += _turning(own, h[:4]) - _turning(seen, h[:4])
        elif count:
            total += _sliding(own[:2] - seen[:2], seen[3:], h[:count], link.travel)
        h = h[count:]
    moving = np.ix_(ends - 1, ends - 1)
    total[moving] -= sign * weight
    return None if h else total


def _free(link: Link, alone: bool) -> list[int]:
    """Components of a body's twist (v, ω) that are not linear in its parent's, that along q̇ last."""
    if link.slides:
        return [2] if alone else [0, 1, 2]
    return [5] if alone else [0, 1, 3, 4, 5]


def _turning(twist: Balls, h: Sequence[Any]) -> Balls:
    """h₁‖v_⊥‖² + h₂‖ω_⊥‖² + h₃v_⊥·ω_⊥ + h₄z·(v_⊥×ω_⊥), which the joint keeps."""
    v, w, across = twist[:2], twist[3:5], np.stack([twist[4], -twist[3]])
    mixed = v.T @ (h[2] * w + h[3] * across)
    return h[0] * v.T @ v + h[1] * w.T @ w + (mixed + mixed.T) / 2


def _sliding(gain: Balls, spin: Balls, h: Sequence[Any], travel: Any) -> Balls:
    """h₁z·(Δ×g) + h₂(Δ − lg)·(Δ − ug) with g = ω×z."""
    g = np.stack([spin[1], -spin[0]])
    form = h[0] * (np.outer(gain[0], g[1]) - np.outer(gain[1], g[0]))
    if travel is not None:
        form = form + h[1] * (gain - travel[0] * g).T @ (gain - travel[1] * g)
    return (form + form.T) / 2


def _constants(document: dict[str, Any]) -> Iterator[Check]:
    """ρ, δ, t, α, β and P (§1, §8)."""
    law, error, friction, n = (
        document["law"],
        document["model_error"],
        document["friction"],
        len(document["law"]["rate"]),
    )
    k: dict[str, Any] = {key: x if x is None else arb(x) for key, x in document["constants"].items()}
    stiffness, floor, rate = balls(law["stiffness"]), balls(law["floor"]), balls(law["rate"])
    if not positive_definite(floor):
        yield decided("D₀", False, "D₀ ≻ 0, §1")
        return
    yield decided("ρ", positive_definite(2 * stiffness - np.diag(k["rho"] / rate)), "2S ≻ ρΛ⁻¹, §1")
    yield decided("δ", positive_definite(floor - np.diag(k["delta"] / rate)), "D₀ ≻ δΛ⁻¹, §1")
    viscous, coulomb = (abs(balls(friction[x]) - balls(friction[f"fed_{x}"])) for x in ("viscous", "coulomb"))
    fed = [i for i in range(n) if not viscous[i].is_zero()]
    known = all(friction["speed"][i] is not None for i in fed)
    box = viscous * balls([x or 0.0 for x in friction["speed"]]) + coulomb
    metric, given = abs(inverse(floor)), document["disturbance"]
    left = k["t"] - error["t"] - (box @ metric @ box).sqrt()
    if given["box"] is None:
        ball = left**2 * floor - np.diag(balls([given["radius"]] * n) ** 2)
        true = given["radius"] == 0.0 or positive_definite(ball)
    else:
        true = certain(balls(given["box"]) @ metric @ balls(given["box"]) <= left**2)
    yield decided("t", true and known and certain(left >= 0), "t² ≥ sup τᵀD₀⁻¹τ of disturbance and friction, §1, §8")
    left = k["alpha"] - error["alpha"]
    true = not fed or positive_definite(left**2 * floor - np.diag(viscous**2 * rate))
    yield decided("α", true and certain(left >= 0), "α²D₀ ≻ ΔbΛΔb, §8")
    yield decided("β", certain(k["beta"] >= error["beta"]), "that of the model error, §5")
    smooth = arb(-1).exp().lambertw() * friction["transition"] * balls(friction["fed_coulomb"]).sum()
    yield decided("P", certain(smooth <= k["power"]), "P ≥ max x(1 − tanh x) ε Σĉ, §8")
    if any(error.values()):
        yield Check("model error", TAKEN, "k/√d, α and β of §5")


def _levels(document: dict[str, Any]) -> Iterator[Check]:
    """The level, the rate and every edge of the polygon (§2, §3)."""
    k: dict[str, Any] = {key: x if x is None else arb(x) for key, x in document["constants"].items()}
    k |= {key: arb(document["law"][key]) for key in ("omega", "coupling")}
    c, storage, rate = (arb(document["level"][key]) for key in ("c", "storage", "rate"))
    spare, potential, cut = c * storage - k["power"], arb(document["bounds"]["potential"]), document["polygon"]
    share = arb(0) if k["t"].is_zero() else k["t"] ** 2 / (4 * spare)
    yield decided("c and V∞", certain(spare >= 0) and _falls(k, c, share), "with the θ, η and r that they leave, §2")
    yield decided("rate", _falls(k, 2 * rate, arb(0)), "of decay without disturbance, §2")
    if cut is None:
        yield decided("Φ∞", certain(potential >= storage), "Φ ≤ V ≤ V∞, §2")
        return
    phi, low, true = arb(cut["start"]), arb(0), certain(potential >= cut["start"])
    for m, high in zip(balls(cut["steepness"]), balls(cut["heights"]), strict=True):
        end = phi - (high - low) / m
        true = true and certain(m >= 1, high > low, end >= 0) and _closed(k, m, end, low, high)
        phi, low = end, high
    yield decided("Φ∞", true and certain(phi + low >= storage), f"{len(cut['heights'])} edges, each by (3) of §3")


def _falls(k: dict[str, Any], c: Any, share: Any) -> bool:
    """Whether V̇ ≤ −cV apart from a share of y² (§2): (1 − η)(1 − β − share − r) ≥ a²/4, c = 2ηρ, c ≤ 2(rκ + ω)."""
    eta, rest = c / (2 * k["rho"]), c / 2 - k["omega"]
    r = arb(0) if rest <= 0 else rest / k["kappa"]
    x, y, a = 1 - eta, 1 - k["beta"] - share - r, k["alpha"] + (1 - k["coupling"]) / k["delta"].sqrt()
    return certain(c > 0, x >= 0, y >= 0, x * y >= a**2 / 4)


def _closed(k: dict[str, Any], m: Any, end: Any, low: Any, high: Any) -> bool:
    """Whether (3) of §3 holds on the whole edge of steepness m down to Φ = `end`, with W from `low` to `high`."""
    a, g, t = (m - k["coupling"]) / k["delta"].sqrt() + k["alpha"], 1 - k["beta"], k["t"]
    x0, y0, bend = (2 * k["rho"] * end).sqrt(), (2 * k["kappa"] * low).sqrt(), g - a**2 / (4 * m)
    found = [y0, (a * x0 + t) / (2 * g)]
    found += [] if a.is_zero() else [2 * m * x0 / a]
    found += [t / (2 * bend)] if bend > 0 else []
    if k["nu"] is not None:
        y1 = (2 * k["nu"] * high).sqrt()
        found = [y.min(y1) for y in (*found, y1)]
    elif not bend > 0:
        return False
    for y in (y.max(y0) for y in found):
        x = x0.max(a * y / (2 * m))
        if not a * x * y - m * x**2 - g * y**2 + t * y - 2 * k["omega"] * low + k["power"] <= 0:
            return False
    return certain(g > 0)


def _errors(document: dict[str, Any]) -> Iterator[Check]:
    """The errors that Φ ≤ Φ∞ allows, and from the start Φ ≤ max(V(0), Φ∞)."""
    stiffness, start, n = balls(document["law"]["stiffness"]), document["start"], len(document["law"]["rate"])

    def bounded(sizes: dict[str, Any], level: float) -> bool:
        """Whether z1ᵀSz1 ≤ level keeps ‖z1‖ and every |z1_i| within these sizes."""
        whole = [(sizes["error"], np.ones(n))]
        single = [(x, np.eye(n)[i]) for i, x in enumerate(sizes["joint_errors"]) if x < sizes["error"]]
        forms = (arb(x) ** 2 * stiffness - np.diag(arb(level) * balls(part)) for x, part in whole + single)
        return level <= 0.0 or all(positive_definite(form) for form in forms)

    level, length = document["bounds"]["potential"], unit(document, "rad", "m")
    yield decided("‖z1‖ and |z1_i|", bounded(document["bounds"], level), "e²S ≻ Φ∞I and e_i²S ≻ Φ∞e_ie_iᵀ, §2")
    if start is not None:
        yield Check("V(0) of the start", TAKEN, f"{start['storage']:.6g} J, which takes the weights of the law")
        yield decided("errors from the start", bounded(start, max(level, start["storage"])), "Φ ≤ max(V(0), Φ∞), §3")
    if document["linear"] is not None:
        yield Check("‖z1‖ of one joint", OPEN, f"{document['linear']['error']:.6g} {length} by linear theory, §4")
    if document["held"] is not None:
        held = document["held"]
        yield Check("‖z1‖ with held torques", OPEN, f"{held['error']:.6g} {length} at {1e3 * held['period']:g} ms, §13")
    for i, joint in enumerate(document["arm"]["joints"] if document["arm"] else []):
        if joint["continuous"]:
            largest = max(sizes["joint_errors"][i] for sizes in (document["bounds"], start) if sizes)
            yield decided(f"π > |z1| of {joint['name']}", certain(largest < arb.pi()), "its error jumps at ±π")
