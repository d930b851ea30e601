"""Symmetric 4×4 matrices: eigenvalues by Jacobi's rotations, and the logistic function of a matrix.

A matrix is sixteen numbers, row by row; in memory and weights it is the ten of its upper triangle, row by row.
"""

import math

from nbs_pin.kernels.jit import inlined, kernel
from nbs_pin.kernels.records import Vec

TRIANGLE = 10
"""Numbers of an upper triangle."""
FARTHEST = 20.72326583694641
"""−log 1e-9: eigenvalues of a dual are kept within ± this, those of its matrix within [1e-9, 1 − 1e-9]."""
SWEEPS, CONVERGED = 12, 1e-34
"""Most passes over all entries off the diagonal; the sum of their squares, as a share of that on it, that ends them."""


@inlined
def whole(triangle: Vec, matrix: Vec) -> None:
    """The matrix of an upper triangle."""
    k = 0
    for i in range(4):
        for j in range(i, 4):
            matrix[4 * i + j] = triangle[k]
            matrix[4 * j + i] = triangle[k]
            k += 1


@kernel
def eigen(a: Vec, v: Vec) -> None:
    """The eigenvalues of a → its diagonal, and eigenvectors → the columns of v.

    Every rotation turns one entry off the diagonal to zero (Golub and Van Loan, Matrix Computations, section 8.5).
    """
    for k in range(16):
        v[k] = 1.0 if k % 5 == 0 else 0.0
    for _ in range(SWEEPS):
        off, size = 0.0, 0.0
        for i in range(4):
            size += a[5 * i] * a[5 * i]
            for j in range(i + 1, 4):
                off += a[4 * i + j] * a[4 * i + j]
        if not off > CONVERGED * size:
            return
        for p in range(3):
            for q in range(p + 1, 4):
                x = a[4 * p + q]
                if x == 0.0:
                    continue
                theta = (a[5 * q] - a[5 * p]) / (2.0 * x)
                t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1.0))
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for k in range(4):  # the columns p and q of A and V
                    y, z = a[4 * k + p], a[4 * k + q]
                    a[4 * k + p], a[4 * k + q] = c * y - s * z, s * y + c * z
                    y, z = v[4 * k + p], v[4 * k + q]
                    v[4 * k + p], v[4 * k + q] = c * y - s * z, s * y + c * z
                for k in range(4):  # the rows
                    y, z = a[4 * p + k], a[4 * q + k]
                    a[4 * p + k], a[4 * q + k] = c * y - s * z, s * y + c * z


@inlined
def with_eigenvalues(values: Vec, v: Vec, matrix: Vec) -> None:
    """V diag(values) Vᵀ → matrix."""
    for i in range(4):
        for j in range(i, 4):
            total = 0.0
            for k in range(4):
                total += v[4 * i + k] * values[k] * v[4 * j + k]
            matrix[4 * i + j] = total
            matrix[4 * j + i] = total


@kernel
def logistic(dual: Vec, work: Vec, x: Vec) -> None:
    """X = (1 + e^−Q)⁻¹ of the dual's upper triangle → x (16), with eigenvalues of Q beyond ±FARTHEST cut in place."""
    a, v, values = work[:16], work[16:32], work[32:36]
    whole(dual, a)
    eigen(a, v)
    cut = False
    for k in range(4):
        y = a[5 * k]
        if abs(y) > FARTHEST:
            cut, y = True, math.copysign(FARTHEST, y)
        values[k] = y
    if cut:
        with_eigenvalues(values, v, x)
        k = 0
        for i in range(4):
            for j in range(i, 4):
                dual[k] = x[4 * i + j]
                k += 1
    for k in range(4):
        values[k] = 1.0 / (1.0 + math.exp(-values[k]))
    with_eigenvalues(values, v, x)


@inlined
def congruent(k: Vec, down: int, across: int, x: Vec, work: Vec, out: Vec) -> None:
    """K X Kᵀ → out, K_ij = k[down·i + across·j]: 4 and 1 take the matrix k, 1 and 4 its transpose."""
    for i in range(4):
        for j in range(4):
            total = 0.0
            for m in range(4):
                total += k[down * i + across * m] * x[4 * m + j]
            work[4 * i + j] = total
    for i in range(4):
        for j in range(4):
            total = 0.0
            for m in range(4):
                total += work[4 * i + m] * k[down * j + across * m]
            out[4 * i + j] = total
