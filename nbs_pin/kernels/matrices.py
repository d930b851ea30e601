"""Products with matrices whose rows lie end to end in a vector, and their adjoints."""

from nbs_pin.kernels.jit import kernel
from nbs_pin.kernels.records import Vec
from nbs_pin.kernels.views import row, take4


@kernel
def times(matrix: Vec, x: Vec, y: Vec) -> None:
    """W x → y."""
    length = len(x)
    for i in range(len(y)):
        w, total = row(matrix, i, length), 0.0
        for j in range(length):
            total += w[j] * x[j]
        y[i] = total


@kernel
def times_dual(matrix: Vec, x: Vec, dx: Vec, y: Vec, dy: Vec) -> None:
    """W x → y and W ẋ → ẏ."""
    length = len(x)
    for i in range(len(y)):
        w = row(matrix, i, length)
        total, rate = 0.0, 0.0
        for j in range(length):
            total += w[j] * x[j]
            rate += w[j] * dx[j]
        y[i], dy[i] = total, rate


@kernel
def add_transposed(matrix: Vec, d: Vec, g: Vec) -> None:
    """Add Wᵀδ to g, four rows of W at a time so that g is fetched and stored less often."""
    size, length = len(d), len(g)
    whole = size - size % 4
    for i in range(0, whole, 4):
        r0, r1, r2, r3, _ = take4(matrix[i * length :], length)
        d0, d1, d2, d3 = d[i], d[i + 1], d[i + 2], d[i + 3]
        for j in range(length):
            g[j] += d0 * r0[j] + d1 * r1[j] + d2 * r2[j] + d3 * r3[j]
    for i in range(whole, size):
        w, di = row(matrix, i, length), d[i]
        for j in range(length):
            g[j] += di * w[j]


@kernel
def times_adjoint(matrix: Vec, x: Vec, y_bar: Vec, x_bar: Vec, matrix_bar: Vec) -> None:
    """Add Wᵀȳ to x̄ and ȳxᵀ to W̄."""
    length = len(x)
    add_transposed(matrix, y_bar, x_bar)
    for i in range(len(y_bar)):
        w_bar, delta = row(matrix_bar, i, length), y_bar[i]
        for j in range(length):
            w_bar[j] += delta * x[j]
