"""One body of a rigid tree: what it gets from its parent, what it makes of it, and what it hands back.

A body accelerates with a(x) = a + Bx, where B = [α]× + ½(ωωʹᵀ + ωʹωᵀ) − (ω·ωʹ)1 is [α]× + [ω]×[ω]× polarised for two
velocities. A body of mass m, h = Σ m x and E = Σ m xxᵀ resists with the force F = m a + Bh and the moment
N = h × a + Σ m x × Bx about its origin; the latter sum is the axial vector of BE − (BE)ᵀ.

With the velocities u and o of the bodies at the joint velocity μ, μᵀτ is the power Σ u·F + o·N, whose derivatives are
gathered inwards. Those with respect to u and o are F and N, summed over the body and all behind it.

Each body has a row of numbers: R of its joint (parent from body), then what is named here.
"""

import numpy as np

from nbs_pin.kernels.jit import kernel
from nbs_pin.kernels.tree_layout import FIRST, MASS, SECOND

P, V, W, ALPHA, A, B, F, N = 9, 12, 15, 18, 21, 24, 33, 36
"""Where p, ω, ω', α, a, B, F, N lie in a row."""
U, SPIN = 39, 42
"""Where u and o lie in a row."""
V_BAR, W_BAR, ALPHA_BAR, A_BAR, B_BAR = 45, 48, 51, 54, 57
"""Where ω̄, ω̄', ᾱ, ā, B̄ lie in a row: the derivatives of the power with respect to ω, ω', α, a, B."""
COMPOSITE = 12
"""Where m, h, E of the body and all behind it lie in a row, while M(q) is made."""


@kernel
def to_parent(r: np.ndarray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """R y: from a body to its parent."""
    return r[0] * x + r[1] * y + r[2] * z, r[3] * x + r[4] * y + r[5] * z, r[6] * x + r[7] * y + r[8] * z


@kernel
def from_parent(r: np.ndarray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Rᵀ y: from the parent to the body."""
    return r[0] * x + r[3] * y + r[6] * z, r[1] * x + r[4] * y + r[7] * z, r[2] * x + r[5] * y + r[8] * z


@kernel
def move(slide: float, v: float, w: float, a: float, up: np.ndarray, row: np.ndarray) -> None:
    """ω, ω', α, a and B of a body from those of its parent."""
    turn = 1.0 - slide
    vx, vy, vz = from_parent(row, up[V], up[V + 1], up[V + 2])
    wx, wy, wz = from_parent(row, up[W], up[W + 1], up[W + 2])
    x, y, z = from_parent(row, up[ALPHA], up[ALPHA + 1], up[ALPHA + 2])
    px, py, pz = row[P], row[P + 1], row[P + 2]
    ax, ay, az = from_parent(
        row,
        up[A] + up[B] * px + up[B + 1] * py + up[B + 2] * pz,
        up[A + 1] + up[B + 3] * px + up[B + 4] * py + up[B + 5] * pz,
        up[A + 2] + up[B + 6] * px + up[B + 7] * py + up[B + 8] * pz,
    )
    kx, ky = vy * w + wy * v, vx * w + wx * v  # (ω × z) w + (ω' × z) v is (kx, −ky, 0)
    vz, wz = vz + turn * v, wz + turn * w
    x, y, z = x + 0.5 * turn * kx, y - 0.5 * turn * ky, z + turn * a
    row[A], row[A + 1], row[A + 2] = ax + slide * kx, ay - slide * ky, az + slide * a
    row[V], row[V + 1], row[V + 2] = vx, vy, vz
    row[W], row[W + 1], row[W + 2] = wx, wy, wz
    row[ALPHA], row[ALPHA + 1], row[ALPHA + 2] = x, y, z
    xx, yy, zz = vx * wx, vy * wy, vz * wz
    xy, xz, yz = 0.5 * (vx * wy + vy * wx), 0.5 * (vx * wz + vz * wx), 0.5 * (vy * wz + vz * wy)
    row[B], row[B + 1], row[B + 2] = -yy - zz, xy - z, xz + y
    row[B + 3], row[B + 4], row[B + 5] = xy + z, -xx - zz, yz - x
    row[B + 6], row[B + 7], row[B + 8] = xz - y, yz + x, -xx - yy


@kernel
def load(body: np.ndarray, row: np.ndarray) -> None:
    """F = m a + Bh and N = h × a + Σ m x × Bx of a body."""
    m, hx, hy, hz = body[MASS], body[FIRST], body[FIRST + 1], body[FIRST + 2]
    exx, exy, exz = body[SECOND], body[SECOND + 1], body[SECOND + 2]
    eyy, eyz, ezz = body[SECOND + 3], body[SECOND + 4], body[SECOND + 5]
    ax, ay, az = row[A], row[A + 1], row[A + 2]
    bxx, bxy, bxz = row[B], row[B + 1], row[B + 2]
    byx, byy, byz = row[B + 3], row[B + 4], row[B + 5]
    bzx, bzy, bzz = row[B + 6], row[B + 7], row[B + 8]
    row[F] = m * ax + bxx * hx + bxy * hy + bxz * hz
    row[F + 1] = m * ay + byx * hx + byy * hy + byz * hz
    row[F + 2] = m * az + bzx * hx + bzy * hy + bzz * hz
    row[N] = hy * az - hz * ay + bzx * exy + bzy * eyy + bzz * eyz - byx * exz - byy * eyz - byz * ezz
    row[N + 1] = hz * ax - hx * az + bxx * exz + bxy * eyz + bxz * ezz - bzx * exx - bzy * exy - bzz * exz
    row[N + 2] = hx * ay - hy * ax + byx * exx + byy * exy + byz * exz - bxx * exy - bxy * eyy - bxz * eyz


@kernel
def hand_force(row: np.ndarray, up: np.ndarray) -> None:
    """Add F and N of a body to those of its parent."""
    fx, fy, fz = to_parent(row, row[F], row[F + 1], row[F + 2])
    x, y, z = to_parent(row, row[N], row[N + 1], row[N + 2])
    px, py, pz = row[P], row[P + 1], row[P + 2]
    up[F] += fx
    up[F + 1] += fy
    up[F + 2] += fz
    up[N] += x + py * fz - pz * fy
    up[N + 1] += y + pz * fx - px * fz
    up[N + 2] += z + px * fy - py * fx


@kernel
def couple(body: np.ndarray, row: np.ndarray) -> None:
    """ω̄, ω̄', ᾱ, ā and B̄ of a body, from u and o and what its children handed over.

    B̄ = u hᵀ + [o]×E, and B̄ reaches α by its axial vector, ω and ω' by its symmetric part less its trace.
    """
    m, hx, hy, hz = body[MASS], body[FIRST], body[FIRST + 1], body[FIRST + 2]
    exx, exy, exz = body[SECOND], body[SECOND + 1], body[SECOND + 2]
    eyy, eyz, ezz = body[SECOND + 3], body[SECOND + 4], body[SECOND + 5]
    ux, uy, uz = row[U], row[U + 1], row[U + 2]
    x, y, z = row[SPIN], row[SPIN + 1], row[SPIN + 2]
    row[A_BAR] += m * ux + y * hz - z * hy
    row[A_BAR + 1] += m * uy + z * hx - x * hz
    row[A_BAR + 2] += m * uz + x * hy - y * hx
    bxx = row[B_BAR] + ux * hx + y * exz - z * exy
    bxy = row[B_BAR + 1] + ux * hy + y * eyz - z * eyy
    bxz = row[B_BAR + 2] + ux * hz + y * ezz - z * eyz
    byx = row[B_BAR + 3] + uy * hx + z * exx - x * exz
    byy = row[B_BAR + 4] + uy * hy + z * exy - x * eyz
    byz = row[B_BAR + 5] + uy * hz + z * exz - x * ezz
    bzx = row[B_BAR + 6] + uz * hx + x * exy - y * exx
    bzy = row[B_BAR + 7] + uz * hy + x * eyy - y * exy
    bzz = row[B_BAR + 8] + uz * hz + x * eyz - y * exz
    row[ALPHA_BAR] += bzy - byz
    row[ALPHA_BAR + 1] += bxz - bzx
    row[ALPHA_BAR + 2] += byx - bxy
    kxx, kyy, kzz = -byy - bzz, -bxx - bzz, -bxx - byy
    kxy, kxz, kyz = 0.5 * (bxy + byx), 0.5 * (bxz + bzx), 0.5 * (byz + bzy)
    x, y, z = row[W], row[W + 1], row[W + 2]
    row[V_BAR] += kxx * x + kxy * y + kxz * z
    row[V_BAR + 1] += kxy * x + kyy * y + kyz * z
    row[V_BAR + 2] += kxz * x + kyz * y + kzz * z
    x, y, z = row[V], row[V + 1], row[V + 2]
    row[W_BAR] += kxx * x + kxy * y + kxz * z
    row[W_BAR + 1] += kxy * x + kyy * y + kyz * z
    row[W_BAR + 2] += kxz * x + kyz * y + kzz * z


@kernel
def hand_bars(row: np.ndarray, up: np.ndarray) -> tuple[float, float, float]:
    """Add ω̄, ω̄', ᾱ, ā and what ā makes of B̄ to those of the parent; R ā."""
    for at in (V_BAR, W_BAR, ALPHA_BAR):
        x, y, z = to_parent(row, row[at], row[at + 1], row[at + 2])
        up[at] += x
        up[at + 1] += y
        up[at + 2] += z
    x, y, z = to_parent(row, row[A_BAR], row[A_BAR + 1], row[A_BAR + 2])
    px, py, pz = row[P], row[P + 1], row[P + 2]
    up[A_BAR] += x
    up[A_BAR + 1] += y
    up[A_BAR + 2] += z
    up[B_BAR] += x * px
    up[B_BAR + 1] += x * py
    up[B_BAR + 2] += x * pz
    up[B_BAR + 3] += y * px
    up[B_BAR + 4] += y * py
    up[B_BAR + 5] += y * pz
    up[B_BAR + 6] += z * px
    up[B_BAR + 7] += z * py
    up[B_BAR + 8] += z * pz
    return x, y, z


@kernel
def joint_bars(slide: float, v: float, w: float, row: np.ndarray) -> tuple[float, float, float]:
    """Derivatives with respect to v, w and a of one joint; adds to ω̄ and ω̄' what α and a take of them there."""
    turn = 1.0 - slide
    x = 0.5 * turn * row[ALPHA_BAR] + slide * row[A_BAR]
    y = 0.5 * turn * row[ALPHA_BAR + 1] + slide * row[A_BAR + 1]
    row[V_BAR] -= y * w
    row[V_BAR + 1] += x * w
    row[W_BAR] -= y * v
    row[W_BAR + 1] += x * v
    v_bar = x * row[W + 1] - y * row[W] + turn * row[V_BAR + 2]
    w_bar = x * row[V + 1] - y * row[V] + turn * row[W_BAR + 2]
    return v_bar, w_bar, turn * row[ALPHA_BAR + 2] + slide * row[A_BAR + 2]


@kernel
def turn_bar(v: float, w: float, row: np.ndarray) -> float:
    """Derivative with respect to the angle of a joint: −z · Σ y × ȳ over all y = Rᵀ(…) of its body."""
    total = row[V] * row[V_BAR + 1] - row[V + 1] * row[V_BAR]
    total += row[W] * row[W_BAR + 1] - row[W + 1] * row[W_BAR]
    total += row[A] * row[A_BAR + 1] - row[A + 1] * row[A_BAR]
    total += row[U] * row[F + 1] - row[U + 1] * row[F]
    total += row[SPIN] * row[N + 1] - row[SPIN + 1] * row[N]
    x = row[ALPHA] - 0.5 * (row[V + 1] * w + row[W + 1] * v)
    y = row[ALPHA + 1] + 0.5 * (row[V] * w + row[W] * v)
    return y * row[ALPHA_BAR] - x * row[ALPHA_BAR + 1] - total


@kernel
def slide_bar(x: float, y: float, z: float, row: np.ndarray, up: np.ndarray) -> float:
    """Derivative with respect to the travel of a joint along R z, with R ā in x, y, z: R ā · B R z + F · (o × z)."""
    dx, dy, dz = row[2], row[5], row[8]
    total = row[F] * row[SPIN + 1] - row[F + 1] * row[SPIN]
    total += x * (up[B] * dx + up[B + 1] * dy + up[B + 2] * dz)
    total += y * (up[B + 3] * dx + up[B + 4] * dy + up[B + 5] * dz)
    return total + z * (up[B + 6] * dx + up[B + 7] * dy + up[B + 8] * dz)


@kernel
def join(row: np.ndarray, up: np.ndarray) -> None:
    """Add m, h and E of a body and all behind it to its parent's: E → RERᵀ + (Rh)pᵀ + p(Rh)ᵀ + m ppᵀ."""
    m, at = row[COMPOSITE], COMPOSITE + 4
    hx, hy, hz = to_parent(row, row[COMPOSITE + 1], row[COMPOSITE + 2], row[COMPOSITE + 3])
    sx, sy, sz = to_parent(row, row[at], row[at + 1], row[at + 2])
    tx, ty, tz = to_parent(row, row[at + 1], row[at + 3], row[at + 4])
    ux, uy, uz = to_parent(row, row[at + 2], row[at + 4], row[at + 5])
    px, py, pz = row[P], row[P + 1], row[P + 2]
    gx, gy, gz = hx + m * px, hy + m * py, hz + m * pz
    up[COMPOSITE] += m
    up[COMPOSITE + 1] += gx
    up[COMPOSITE + 2] += gy
    up[COMPOSITE + 3] += gz
    up[at] += sx * row[0] + tx * row[1] + ux * row[2] + (hx + gx) * px
    up[at + 1] += sx * row[3] + tx * row[4] + ux * row[5] + gx * py + px * hy
    up[at + 2] += sx * row[6] + tx * row[7] + ux * row[8] + gx * pz + px * hz
    up[at + 3] += sy * row[3] + ty * row[4] + uy * row[5] + (hy + gy) * py
    up[at + 4] += sy * row[6] + ty * row[7] + uy * row[8] + gy * pz + py * hz
    up[at + 5] += sz * row[6] + tz * row[7] + uz * row[8] + (hz + gz) * pz
