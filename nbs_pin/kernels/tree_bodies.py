"""One body of a rigid tree: what it gets from its parent, what it makes of it, and what it hands back.

All vectors of a body are in its own frame, whose z axis is the axis of its joint; R and p place that frame in the
parent's: y in the body's frame is R y in the parent's, and the origin of the body's frame lies at p there.

A body accelerates with a(x) = a + Bx, where B = [α]× + ½(ωωʹᵀ + ωʹωᵀ) − (ω·ωʹ)1 is [α]× + [ω]×[ω]× polarised for two
velocities, ω of the joint velocities v and ω' of w. A body of mass m, h = Σ m x and E = Σ m xxᵀ resists with the force
F = m a + Bh and the moment N = h × a + Σ m x × Bx about its origin; the latter sum is the axial vector of BE − (BE)ᵀ.

With the velocities u and o of the bodies at the joint velocity μ, μᵀτ is the power Σ u·F + o·N, whose derivatives are
gathered inwards. Those with respect to u and o are F and N, summed over the body and all behind it.

Each body has a row of numbers, matrices row by row:

    R, P               R (9) and p (3) of its joint
    V, W, ALPHA        ω and ω', angular velocities at v and w, and α, angular acceleration
    A, B               a, acceleration of the origin, and B (9)
    F, N               force and moment, of the body alone after `load`, of it and all behind it after `hand_force`
    U, SPIN            u and o, velocity of the origin and angular velocity at μ
    V_BAR … B_BAR      derivatives of the power with respect to ω, ω', α, a, B
    COMPOSITE          m, h, E of it and all behind it, while M(q) is made

The row of the base has ω = ω' = α = 0 and a = −gravity.
"""

import math
from collections import namedtuple

from nbs_pin.kernels.jit import inlined
from nbs_pin.kernels.layout import JointCode, Packed
from nbs_pin.kernels.records import Vec
from nbs_pin.kernels.spatial import Three, add, cross, dot, get, plus, put, scaled, times, transposed_times
from nbs_pin.kernels.tree_layout import BASE, BODY, FIRST, MASS, PER_JOINT, ROW, SECOND, TREE_JOINTS

R, P, V, W, ALPHA, A, B, F, N = 0, 9, 12, 15, 18, 21, 24, 33, 36
U, SPIN = 39, 42
V_BAR, W_BAR, ALPHA_BAR, A_BAR, B_BAR = 45, 48, 51, 54, 57
COMPOSITE = 12
"""Where things lie in a row, as above."""

Joint = namedtuple("Joint", "slide body row up")
"""A joint and the body behind it: 1 for a prismatic joint, 0 for a revolute one; its weights (`tree_layout.py`), its
row of numbers, and its parent's."""


@inlined
def joint_of(i: int, tree: Packed, work: Vec) -> Joint:
    """Joint i; `slide` of a joint that is neither prismatic nor revolute is NaN, and so is all that follows from it."""
    at, start, slide = TREE_JOINTS + PER_JOINT * i, BASE + BODY * i, math.nan
    parent, code = tree.layout[at], tree.layout[at + 1]
    if code == JointCode.REVOLUTE:
        slide = 0.0
    elif code == JointCode.PRISMATIC:
        slide = 1.0
    row, up = work[ROW * (i + 1) : ROW * (i + 2)], work[ROW * parent : ROW * (parent + 1)]
    return Joint(slide, tree.weights[start : start + BODY], row, up)


@inlined
def along(slide: float, force: float, moment: float) -> float:
    """What acts along a prismatic joint or about a revolute one."""
    if slide == 1.0:
        return force
    return moment if slide == 0.0 else math.nan


@inlined
def move(joint: Joint, v: float, w: float, a: float) -> None:
    """ω, ω', α, a and B of a body from those of its parent, which R and p bring into its frame first: ω₀ = Rᵀω, ….

    revolute    ω = ω₀ + v z, ω' = ω'₀ + w z, α = α₀ + a z + ½k, a = Rᵀ(a + Bp), with k = (ω₀ × z) w + (ω'₀ × z) v
    prismatic   ω = ω₀, ω' = ω'₀, α = α₀, a = Rᵀ(a + Bp) + a z + k
    """
    row, up, slide, turn = joint.row, joint.up, joint.slide, 1.0 - joint.slide
    vx, vy, vz = transposed_times(row, R, get(up, V))
    wx, wy, wz = transposed_times(row, R, get(up, W))
    x, y, z = transposed_times(row, R, get(up, ALPHA))
    ax, ay, az = transposed_times(row, R, plus(get(up, A), times(up, B, get(row, P))))
    kx, ky = vy * w + wy * v, -(vx * w + wx * v)
    vz, wz = vz + turn * v, wz + turn * w
    x, y, z = x + 0.5 * turn * kx, y + 0.5 * turn * ky, z + turn * a
    put(row, A, (ax + slide * kx, ay + slide * ky, az + slide * a))
    put(row, V, (vx, vy, vz))
    put(row, W, (wx, wy, wz))
    put(row, ALPHA, (x, y, z))
    xx, yy, zz = vx * wx, vy * wy, vz * wz
    xy, xz, yz = 0.5 * (vx * wy + vy * wx), 0.5 * (vx * wz + vz * wx), 0.5 * (vy * wz + vz * wy)
    put(row, B, (-yy - zz, xy - z, xz + y))
    put(row, B + 3, (xy + z, -xx - zz, yz - x))
    put(row, B + 6, (xz - y, yz + x, -xx - yy))


@inlined
def second_moments(body: Vec) -> tuple[Three, Three, Three]:
    """The rows of E."""
    (xx, xy, xz), (yy, yz, zz) = get(body, SECOND), get(body, SECOND + 3)
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


@inlined
def load(joint: Joint) -> None:
    """F = m a + Bh and N = h × a + Σ m x × Bx of a body alone."""
    body, row = joint.body, joint.row
    h, a, (ex, ey, ez) = get(body, FIRST), get(row, A), second_moments(body)
    bx, by, bz = get(row, B), get(row, B + 3), get(row, B + 6)
    put(row, F, plus(scaled(body[MASS], a), times(row, B, h)))
    axial = dot(bz, ey) - dot(by, ez), dot(bx, ez) - dot(bz, ex), dot(by, ex) - dot(bx, ey)
    put(row, N, plus(cross(h, a), axial))


@inlined
def hand_force(joint: Joint) -> None:
    """Add F and N of a body to those of its parent: R F and R N + p × R F."""
    row, force = joint.row, times(joint.row, R, get(joint.row, F))
    add(joint.up, F, force)
    add(joint.up, N, plus(times(row, R, get(row, N)), cross(get(row, P), force)))


@inlined
def couple(joint: Joint) -> None:
    """ω̄, ω̄', ᾱ, ā and B̄ of a body, from u and o and what its children handed over.

    The power of F and N is linear in a and B: ā = m u + o × h and B̄ = u hᵀ + [o]×E, to which the children's ā has
    added ā pᵀ. Through B = [α]× + ½(ωωʹᵀ + ωʹωᵀ) − (ω·ωʹ)1, B̄ reaches α by the axial vector of B̄ − B̄ᵀ, and ω and ω'
    by ω̄ = Kω' and ω̄' = Kω with K = ½(B̄ + B̄ᵀ) − tr(B̄)1.
    """
    body, row = joint.body, joint.row
    h, u, o, (ex, ey, ez) = get(body, FIRST), get(row, U), get(row, SPIN), second_moments(body)
    add(row, A_BAR, plus(scaled(body[MASS], u), cross(o, h)))
    add(row, B_BAR, plus(scaled(u[0], h), plus(scaled(o[1], ez), scaled(-o[2], ey))))
    add(row, B_BAR + 3, plus(scaled(u[1], h), plus(scaled(o[2], ex), scaled(-o[0], ez))))
    add(row, B_BAR + 6, plus(scaled(u[2], h), plus(scaled(o[0], ey), scaled(-o[1], ex))))
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = get(row, B_BAR), get(row, B_BAR + 3), get(row, B_BAR + 6)
    add(row, ALPHA_BAR, (zy - yz, xz - zx, yx - xy))
    kxy, kxz, kyz = 0.5 * (xy + yx), 0.5 * (xz + zx), 0.5 * (yz + zy)
    kx, ky, kz = (-yy - zz, kxy, kxz), (kxy, -xx - zz, kyz), (kxz, kyz, -xx - yy)
    v, w = get(row, V), get(row, W)
    add(row, V_BAR, (dot(kx, w), dot(ky, w), dot(kz, w)))
    add(row, W_BAR, (dot(kx, v), dot(ky, v), dot(kz, v)))


@inlined
def hand_bars(joint: Joint) -> Three:
    """Add ω̄, ω̄', ᾱ, ā and what ā makes of B̄, ā pᵀ, to those of the parent; R ā."""
    row, up = joint.row, joint.up
    for at in (V_BAR, W_BAR, ALPHA_BAR):
        add(up, at, times(row, R, get(row, at)))
    a_bar, p = times(row, R, get(row, A_BAR)), get(row, P)
    add(up, A_BAR, a_bar)
    for k in range(3):
        add(up, B_BAR + 3 * k, scaled(a_bar[k], p))
    return a_bar


@inlined
def joint_bars(joint: Joint, v: float, w: float) -> Three:
    """Derivatives with respect to v, w and a of one joint; adds to ω̄ and ω̄' what α and a take of them there."""
    row, slide, turn = joint.row, joint.slide, 1.0 - joint.slide
    x = 0.5 * turn * row[ALPHA_BAR] + slide * row[A_BAR]
    y = 0.5 * turn * row[ALPHA_BAR + 1] + slide * row[A_BAR + 1]
    row[V_BAR] -= y * w
    row[V_BAR + 1] += x * w
    row[W_BAR] -= y * v
    row[W_BAR + 1] += x * v
    v_bar = x * row[W + 1] - y * row[W] + turn * row[V_BAR + 2]
    w_bar = x * row[V + 1] - y * row[V] + turn * row[W_BAR + 2]
    return v_bar, w_bar, turn * row[ALPHA_BAR + 2] + slide * row[A_BAR + 2]


@inlined
def turn_bar(joint: Joint, v: float, w: float, a: float, mu: float) -> Three:
    """Derivative with respect to a turn δ of the joint's frame, R → R exp[δ]×, of which z is the joint's angle.

    It turns all y₀ = Rᵀ(…) that the body has from its parent: Σ ȳ × y₀ over ω, ω', α, a, u (ū = F) and o (ō = N), y₀
    being y less what the joint's own motion adds (`move`, `trees.spread`).
    """
    row, slide, turn = joint.row, joint.slide, 1.0 - joint.slide
    (vx, vy, vz), (wx, wy, wz) = get(row, V), get(row, W)
    kx, ky = vy * w + wy * v, -(vx * w + wx * v)
    total = plus(cross(get(row, V_BAR), (vx, vy, vz - turn * v)), cross(get(row, W_BAR), (wx, wy, wz - turn * w)))
    x, y, z = get(row, ALPHA)
    total = plus(total, cross(get(row, ALPHA_BAR), (x - 0.5 * turn * kx, y - 0.5 * turn * ky, z - turn * a)))
    x, y, z = get(row, A)
    total = plus(total, cross(get(row, A_BAR), (x - slide * kx, y - slide * ky, z - slide * a)))
    x, y, z = get(row, U)
    total = plus(total, cross(get(row, F), (x, y, z - slide * mu)))
    x, y, z = get(row, SPIN)
    return plus(total, cross(get(row, N), (x, y, z - turn * mu)))


@inlined
def shift_bar(joint: Joint, a_bar: Three) -> Three:
    """Derivative with respect to p, with R ā in a_bar: Bᵀ R ā + R F × o, B and o of the parent."""
    force = times(joint.row, R, get(joint.row, F))
    return plus(transposed_times(joint.up, B, a_bar), cross(force, get(joint.up, SPIN)))


@inlined
def join(joint: Joint) -> None:
    """Add m, h and E of a body and all behind it to its parent's: E → RERᵀ + (Rh)pᵀ + p(Rh)ᵀ + m ppᵀ."""
    row, up, at, p = joint.row, joint.up, COMPOSITE + 4, get(joint.row, P)
    m, h = row[COMPOSITE], times(row, R, get(row, COMPOSITE + 1))
    moved = plus(h, scaled(m, p))
    up[COMPOSITE] += m
    add(up, COMPOSITE + 1, moved)
    (xx, xy, xz), (yy, yz, zz) = get(row, at), get(row, at + 3)
    ex, ey, ez = times(row, R, (xx, xy, xz)), times(row, R, (xy, yy, yz)), times(row, R, (xz, yz, zz))
    k = at
    for i in range(3):
        for j in range(i, 3):  # (R E Rᵀ)_ij from the rows of E Rᵀ
            up[k] += (
                ex[i] * row[3 * j] + ey[i] * row[3 * j + 1] + ez[i] * row[3 * j + 2] + moved[i] * p[j] + p[i] * h[j]
            )
            k += 1
