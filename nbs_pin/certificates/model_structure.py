"""What is known of a model without trusting whoever built it: M̂ ≻ 0, Ṁ − 2C skew, its fit and its box."""

from collections.abc import Callable, Iterable
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Float
from torch import nn

from nbs_pin.accuracy.mismatch import Mismatch, violation_chance
from nbs_pin.base.arrays import matvec
from nbs_pin.base.claims import Claim, Label
from nbs_pin.base.exceptions import ArgumentError, CertificateRefused
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.dynamics.chain import Chain
from nbs_pin.dynamics.cholesky import CholeskyNetwork
from nbs_pin.dynamics.features import JointFeatures
from nbs_pin.dynamics.identified import IdentifiedDynamics
from nbs_pin.dynamics.lagrangian import LagrangianDynamics
from nbs_pin.dynamics.lagrangian_network import LagrangianNetwork
from nbs_pin.dynamics.picnn import PICNN, HomogenisedPicnn, PaperPicnn
from nbs_pin.dynamics.pinocchio import PinocchioDynamics, pack_model
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.dynamics.residual import ResidualDynamics, ResidualNetwork
from nbs_pin.dynamics.scales import Scales
from nbs_pin.dynamics.softplus_network import SoftplusNetwork
from nbs_pin.dynamics.tanh_network import TanhNetwork
from nbs_pin.dynamics.unconstrained import UnconstrainedLagrangian
from nbs_pin.identification.datasets import joint_tree
from nbs_pin.inertia.rigid_tree import RigidTree
from nbs_pin.kernels.layout import Packed
from nbs_pin.robots.robot import Robot

_POSITIVE = "M̂ ≻ 0"
_SKEW = "Ṁ − 2C skew, largest deviation"
_SAMPLES = 24
_ROUNDING = 1e-10
_PARTS = (JointFeatures, Scales, TanhNetwork, SoftplusNetwork, PICNN)
_HOOKS = ("_forward_hooks", "_forward_pre_hooks")


def check_model(provider: DynamicsProvider, robot: Robot | None = None) -> tuple[Claim, ...]:
    """How it is known that M̂(q) ≻ 0 and that Ṁ − 2C is skew, from the numbers and the code the model now has.

    Rigid trees, M̂ = LLᵀ + εI, the quadratic PICNN and residuals on a sound nominal model are PROVED; models of other
    classes, or with a method replaced, are EMPIRICAL, on sampled states. robot: the arm the model should be of.
    Raises CertificateRefused for a model of another arm, numbers that are not finite, an M̂ without its εI or with a
    negative eigenvalue, and a C that is not the Christoffel one (docs/theory.md §1, §6).
    """
    if not isinstance(provider, DynamicsProvider):
        refuse(f"the model is a {type(provider).__name__}", "give a DynamicsProvider, such as PinocchioDynamics(robot)")
    _check_arm(provider, robot)
    check_finite("the model", provider)
    positive, skew = _known_claims(provider) or _sampled_claims(provider, _strangeness(provider))
    _check_routes(provider, skew)
    return positive, skew


def check_fit(mismatch: Mismatch) -> Claim:
    """The chance ε that a further trajectory breaks ‖δ‖ ≤ a‖q‖ + b‖v‖ + c, computed again from its trajectories.

    PROBABILISTIC with its β and N; EMPIRICAL where ε ≥ ½, as with few trajectories: then the bound describes its data
    and nothing else. Copies of a trajectory are counted once. Raises CertificateRefused for constants that are negative
    or not finite, or that its own data exceed.
    """
    m = mismatch
    constants = np.array([m.a, m.b, m.c])
    if not (np.isfinite(constants).all() and (constants >= 0.0).all() and 0.0 < m.doubt < 1.0):
        refuse(f"the mismatch has a, b, c = {constants.tolist()} and β = {m.doubt}", "fit it again with `mismatch`")
    excess = m.size - m.bound(m.q_norm, m.v_norm)
    if not m.size.size or not bool((excess <= 1e-9 * (1.0 + m.size.max())).all()):
        refuse("the mismatch exceeds the bound a‖q‖ + b‖v‖ + c in its own data", "fit it again with `mismatch`")
    distinct = np.unique(np.concatenate([m.q_norm, m.v_norm, m.size]), axis=1).shape[1]
    count = min(int(m.trajectories), distinct)
    chance = max(violation_chance(count, m.doubt), float(m.violation))
    said = f"{count} independent trajectories, confidence 1 − {m.doubt:g}, for the law, arm and reference they ran with"
    name = "‖δ‖ ≤ a‖q‖ + b‖v‖ + c, chance that a trajectory breaks it"
    if chance < 0.5:
        return Claim(name, chance, "", Label.PROBABILISTIC, f"scenario theorem over {said}")
    because = f"{said}: too few, so the bound describes its own data alone; 374 trajectories give 5 %"
    return Claim(name, chance, "", Label.EMPIRICAL, because)


def check_box(
    positions: Float[np.ndarray, "rows n"],
    low: Float[np.ndarray, " n"],
    high: Float[np.ndarray, " n"],
    *,
    error: Float[np.ndarray, " n"] | float = 0.0,
    box: str = "the joint limits",
) -> Claim:
    """How far the reference with its tube stays inside a box [rad, m]: the least distance to a side, over the rows.

    positions: of the reference. low, high: sides of the box, ∓inf where it has none. error: |z1_i| around the
    reference. box: what the box is, in words. EMPIRICAL, as nothing is said between the rows.
    Raises CertificateRefused where the reference or its tube leaves the box, or a number is NaN.
    """
    inside = np.minimum(positions - low, high - positions) - error
    if not positions.size or np.isnan(inside).any():
        refuse(f"the reference or {box} has no rows or numbers that are none", "give finite positions and sides")
    margin, joint = float(inside.min()), int(inside.min(axis=0).argmin())
    if margin < 0.0:
        refuse(
            f"{box} is too small for the reference: with its error it leaves it at joint {joint + 1} by {-margin:.3g}",
            "give a larger box or a smaller motion",
        )
    because = f"least over {len(positions)} instants and all joints; nothing is said between the instants"
    return Claim(f"reference inside {box}, least margin", margin, "rad", Label.EMPIRICAL, because)


def refuse(fault: str, remedy: str) -> NoReturn:
    """Raise CertificateRefused in one sentence."""
    raise CertificateRefused(f"{fault}; {remedy}.")


def strange(part: Any, *known: type) -> str:
    """Why the part's code may not be that of one of these classes: its class, or what it replaces; empty if it is."""
    kind = type(part)
    if kind not in known:
        return f"{kind.__name__} is not the package's {' or '.join(k.__name__ for k in known)}"
    own = getattr(part, "__dict__", {})
    replaced = sorted(n for n in own if callable(own[n]) and callable(getattr(kind, n, None)))
    hooks = [name.strip("_") for name in _HOOKS if own.get(name)]
    return f"'{(replaced + hooks)[0]}' of this {kind.__name__} is not the package's" if replaced + hooks else ""


def first_strange(parts: Iterable[Any], *known: type) -> str:
    """The first reason that `strange` finds."""
    return next((why for why in (strange(part, *known) for part in parts) if why), "")


def check_finite(name: str, part: Any) -> None:
    """Raises CertificateRefused for a parameter or fixed number that is not finite."""
    if not isinstance(part, nn.Module):
        return
    for key, x in (*part.named_parameters(), *part.named_buffers()):
        bad = int((~x.isfinite()).sum())
        if bad:
            refuse(f"'{key}' of {name} has {bad} numbers that are not finite", "load the last sound checkpoint")


def is_exact(dynamics: DynamicsProvider, robot: Robot | None) -> bool:
    """Whether a model is the arm: Pinocchio's of it, or a closed form that agrees with that to rounding.

    Where no arm is known a closed form counts as exact: the certificate is then about the arm that it describes.
    """
    if type(dynamics) is PinocchioDynamics:
        return robot is None or dynamics.robot.sha256 == robot.sha256
    if type(dynamics) is not AnalyticDynamics:
        return False
    if robot is None:
        return True
    # Both are linear in ten inertial parameters per body, so generic states tell any difference.
    q, v, v_r, a_r = sample_states(dynamics, 50), *np.random.default_rng(1).standard_normal((3, 50, dynamics.nv))
    truth = PinocchioDynamics(robot).reference_torque(q[0], v, v_r, a_r)
    return bool(
        np.allclose(dynamics.reference_torque(q[0], v, v_r, a_r), truth, rtol=1e-9, atol=1e-9 * np.abs(truth).max())
    )


def sample_states(provider: DynamicsProvider, count: int, seed: int = 0) -> list[Float[np.ndarray, "count n"]]:
    """Seeded q within the arm's limits, a full turn where there are none, and three vectors of order one."""
    rng, n = np.random.default_rng(seed), provider.nv
    low, high = (-np.pi, np.pi) if provider.robot is None else provider.robot.sampling_range
    return [rng.uniform(low, high, (count, n)), *rng.normal(size=(3, count, n))]


def _check_arm(provider: DynamicsProvider, robot: Robot | None) -> None:
    """Raises CertificateRefused for a model of another arm than the one given, or than the one it names."""
    own = provider.robot
    if own is not None and own.nv != provider.nv:
        refuse(f"the model has {provider.nv} joints and its arm {own.name} {own.nv}", "give the model of that arm")
    if robot is not None and (robot.nv != provider.nv or (own is not None and own.sha256 != robot.sha256)):
        named = "no named arm" if own is None else f"{own.name} ({own.sha256:.12})"
        refuse(
            f"the model is of {named} with {provider.nv} joints, not of {robot.name} ({robot.sha256:.12})",
            "give the model of this arm",
        )
    arm = own if own is not None else robot
    if arm is not None and isinstance(provider, LagrangianDynamics):
        _check_joints(provider.network, arm)


def _check_joints(network: LagrangianNetwork, robot: Robot) -> None:
    """Raises CertificateRefused for a network of other joints than the arm's."""
    parents, slides = joint_tree(robot)
    if isinstance(network, Chain):
        fits = list(network.parents) == parents.tolist() and list(network.prismatic) == slides.tolist()
    elif isinstance(network, CholeskyNetwork | HomogenisedPicnn | PaperPicnn | UnconstrainedLagrangian):
        fits = network.features.prismatic.tolist() == slides.tolist()
    else:
        return
    if not fits:
        refuse(f"the network's joints are not those of {robot.name}", "give the model that was learned from this arm")


def _known_claims(provider: DynamicsProvider) -> tuple[Claim, Claim] | None:
    """The claims of a model whose code is the package's; None for another."""
    if _strangeness(provider):
        return None
    if isinstance(provider, LagrangianDynamics):
        return _network_claims(provider)
    if isinstance(provider, AnalyticDynamics):
        return _two_link(provider), _christoffel()
    tree = provider.packed_tree()
    if tree is None:
        return None
    if isinstance(provider, PinocchioDynamics) and not _same(tree, pack_model(provider.robot.model)):
        refuse(f"the model is not of {provider.robot.name}, the arm it names", "build it again from that arm")
    positive = _tree_positive(tree)
    return None if positive is None else (positive, _christoffel())


def _strangeness(provider: DynamicsProvider) -> str:
    """Why the model's code may not be the package's; empty if it is."""
    why = strange(
        provider, PinocchioDynamics, IdentifiedDynamics, AnalyticDynamics, LagrangianDynamics, ResidualDynamics
    )
    if why or not isinstance(provider, LagrangianDynamics):
        return why
    networks = (Chain, CholeskyNetwork, HomogenisedPicnn, PaperPicnn, ResidualNetwork, UnconstrainedLagrangian)
    return strange(provider.network, *networks) or first_strange(provider.network.modules(), *networks, *_PARTS)


def _network_claims(provider: LagrangianDynamics) -> tuple[Claim, Claim] | None:
    network = provider.network
    if isinstance(network, UnconstrainedLagrangian):
        refuse(
            "nothing makes the inertia of an UnconstrainedLagrangian positive definite",
            "learn a 'chain', 'cholesky' or 'homogenised' model",
        )
    if isinstance(network, ResidualNetwork):
        return _residual(network), _christoffel()
    if isinstance(network, Chain):
        return _chain(network, provider.packed_tree()), _christoffel()
    if isinstance(network, CholeskyNetwork):
        return _floored(network.scales, "M̂ = LLᵀ + εI"), _christoffel()
    if isinstance(network, HomogenisedPicnn):
        return _floored(network.scales, "M̂ = ∂²f/∂v² + εI, f convex with its gates clipped"), _christoffel()
    if isinstance(network, PaperPicnn):
        positive = _floored(network.scales, "∂²T̂/∂v² of a PICNN convex in v, gates clipped, and εI")
        because = "T̂ is not quadratic in v, so V̇ has a term ½z2ᵀ(∂M̂/∂v v̇)z2 that nothing bounds"
        return positive, Claim(_SKEW, np.inf, "", Label.EMPIRICAL, because)
    return None


def _floored(scales: Scales, because: str) -> Claim:
    epsilon = float(scales.epsilon)
    if not epsilon > 0.0:
        refuse(f"the model's M̂ has ε = {epsilon:g}", "εI must be positive, or M̂ may be singular: learn it with ε > 0")
    return Claim(_POSITIVE, epsilon, "kg·m²", Label.PROVED, f"{because} ⪰ εI for every weight")


def _chain(network: Chain, used: Packed | None) -> Claim:
    parents, n = list(network.parents), network.nv
    if len(parents) != n or len(network.prismatic) != n or any(not 0 <= p <= i for i, p in enumerate(parents)):
        refuse(f"the chain's parents {parents} make no tree of {n} joints", "give parents first, 0 for the base")
    if not 0.0 < network.epsilon < np.inf:
        refuse(f"the model's M̂ has ε = {network.epsilon:g}", "εI must be positive, or M̂ may be singular: give ε > 0")
    if used is not None and not _same(used, network.packed_tree()):
        refuse("the chain's machine code is not that of its weights", "load the model again")
    least = network.epsilon + float(np.min(network.rotors.numpy(force=True) ** 2))
    return Claim(_POSITIVE, least, "kg·m²", Label.PROVED, "M̂ = Σ_j B_jᵀB_j + diag(r² + ε) ⪰ min(r² + ε)I")


def _residual(network: ResidualNetwork) -> Claim:
    if not 0.0 < network.share < 1.0:
        refuse(f"the residual keeps a share κ = {network.share} of M", "κ must lie in (0, 1) for M̂ ⪰ κM ≻ 0")
    inner = check_model(network.nominal)[0]
    because = f"M̂ ⪰ κM with κ = {network.share:g}, and of the nominal model: {inner.because}"
    return Claim(_POSITIVE, network.share * inner.value, inner.unit, inner.label, because)


def _two_link(provider: AnalyticDynamics) -> Claim:
    """M̂ of the numbers the equations run on: det M̂ ≥ m₁m₂l₁²l₂² > 0."""
    try:
        stated = AnalyticDynamics(provider.masses, provider.lengths, provider.gravity_constant)
    except ArgumentError as error:
        raise CertificateRefused(f"the two-link model is none: {error}") from error
    q, v, w, a = sample_states(provider, _SAMPLES)
    same = (x.reference_torque(q, v, w, a) for x in (stated, provider))
    if not np.array_equal(*same):
        refuse("the two-link model does not move as its masses and lengths say", "build it again from them")
    (m1, m2), (l1, l2) = provider.masses, provider.lengths
    trace = (m1 + m2) * l1 * l1 + 2.0 * m2 * l2 * l2 + 2.0 * m2 * l1 * l2
    least = (1.0 - _ROUNDING) * m1 * m2 * (l1 * l2) ** 2 / trace
    return Claim(_POSITIVE, least, "kg·m²", Label.PROVED, "closed form: least eigenvalue ≥ det M / largest trace")


def _tree_positive(packed: Packed) -> Claim | None:
    """M̂ ≻ 0 of a rigid tree: det M̂ ≥ ∏ S_iᵀI_iS_i, the inertia of each body alone about its own joint's axis.

    The pivots of M̂ are S_iᵀI_i^A S_i with articulated inertias I_i^A ⪰ I_i, as every body's inertia is ⪰ 0.
    None where a body alone resists its joint with nothing: M̂ ≻ 0 may still hold, but not by this.
    """
    if not np.isfinite(packed.weights).all():
        refuse("the arm's model has numbers that are not finite", "load the arm again")
    tree = RigidTree.of(packed)
    size = np.abs(tree.inertia).max(axis=(1, 2)) + tree.mass * (tree.centre**2).sum(axis=1)
    least = np.linalg.eigvalsh(tree.inertia)[:, 0]
    bad = (tree.mass < 0.0) | (tree.armature < 0.0) | (least < -_ROUNDING * np.abs(size))
    if bad.any():
        i = int(bad.argmax())
        refuse(
            f"the body behind joint {i + 1} has mass {tree.mass[i]:.3g} kg, rotor inertia {tree.armature[i]:.3g} kg·m² "
            f"and an inertia with the eigenvalue {least[i]:.3g} kg·m²",
            "give bodies that can exist",
        )
    about = tree.inertia[:, 2, 2] + tree.mass * (tree.centre[:, :2] ** 2).sum(axis=1)
    own = np.where(tree.prismatic, tree.mass, np.where(about > _ROUNDING * size, about, 0.0)) + tree.armature
    if own.min() <= 0.0:
        return None
    because = "rigid tree: det M̂ ≥ ∏ S_iᵀI_iS_i > 0 at every q; value: the least factor"
    return Claim(_POSITIVE, float(own.min()), "kg·m²", Label.PROVED, because)


def _same(one: Packed, other: Packed) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(one, other, strict=True))


def _christoffel() -> Claim:
    return Claim(_SKEW, 0.0, "", Label.PROVED, "T̂ = ½vᵀM̂(q)v and C its Christoffel matrix")


def _sampled_claims(provider: DynamicsProvider, why: str) -> tuple[Claim, Claim]:
    """M̂ ≻ 0 and Ṁ = C + Cᵀ on sampled states; raises CertificateRefused where one of them does not hold."""
    q, v, _, _ = sample_states(provider, 4 * _SAMPLES)
    mass = _finite(provider.mass_matrix, q)
    size = np.abs(mass).max(axis=(-2, -1))
    skewed = np.abs(mass - mass.mT).max(axis=(-2, -1)) / size
    least = np.linalg.eigvalsh(0.5 * (mass + mass.mT))[:, 0]
    for bad, fault in ((skewed > 1e-9, "not symmetric"), (least <= 0.0, "not positive definite")):
        if bad.any():
            at = int(bad.argmax())
            refuse(f"M̂ is {fault} at q = {np.round(q[at], 3).tolist()}", "give a model whose M̂ is an inertia")
    step = 1e-5
    rate = (_finite(provider.mass_matrix, q + step * v) - _finite(provider.mass_matrix, q - step * v)) / (2.0 * step)
    coriolis = _finite(provider.coriolis_matrix, q, v)
    off = np.abs(rate - coriolis - coriolis.mT).max(axis=(-2, -1)) / (size + np.abs(rate).max(axis=(-2, -1)))
    if off.max() > 1e-4:
        at = np.round(q[int(off.argmax())], 3).tolist()
        refuse(f"Ṁ − 2C is not skew at q = {at}", "give the Christoffel C of M̂")
    said = f"{why or 'a body alone resists its joint with nothing'}: held at {len(q)} sampled states"
    return (
        Claim(_POSITIVE, float(least.min()), "kg·m²", Label.EMPIRICAL, said),
        Claim(_SKEW, float(off.max()), "", Label.EMPIRICAL, said),
    )


def _check_routes(provider: DynamicsProvider, skew: Claim) -> None:
    """Raises CertificateRefused unless reference_torque is M a + C w + G, whichever code it runs."""
    if not np.isfinite(skew.value):
        return  # not quadratic: its exact torque is another
    q, v, w, a = sample_states(provider, _SAMPLES, seed=1)
    parts = [
        matvec(_finite(provider.mass_matrix, q), a),
        matvec(_finite(provider.coriolis_matrix, q, v), w),
        _finite(provider.gravity, q),
    ]
    off = np.abs(_finite(provider.reference_torque, q, v, w, a) - sum(parts)).max()
    if off > 1e-6 * sum(np.abs(part).max() for part in parts):
        refuse(f"the model's reference torque is {off:.3g} N·m from its M a + C v + G", "load or build it again")


def _finite(function: Callable[..., np.ndarray], *arguments: np.ndarray) -> np.ndarray:
    value = function(*arguments)
    if not np.isfinite(value).all():
        refuse("the model gives numbers that are not finite", "load the last sound checkpoint or build it again")
    return value
