"""The tracking figure: written whole, for any number of joints, and drawn from the right numbers."""

import struct

import numpy as np
import pytest

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Run
from nbs_pin.reports.plotting import plot_tracking, stretches, thin


def sinusoid_run(n, *, batch=(), rows=301, limit=5.0, names=None, **fields):
    """A run that follows a sinusoid with an error that dies out."""
    t = np.linspace(0.0, 3.0, rows)
    shape = (rows, *batch, n)
    clock = t.reshape(-1, *(1 for _ in shape[1:]))
    q_ref = np.broadcast_to(np.sin(clock + np.arange(n)), shape)
    q = q_ref + 0.3 * np.exp(-2.0 * clock)
    asked = np.broadcast_to(8.0 * np.cos(clock), shape)
    record = dict(
        t=t, q=q, v=0 * q, tau=np.clip(asked, -limit, limit), tau_command=asked, disturbance=0 * q, q_ref=q_ref,
        v_ref=0 * q, a_ref=0 * q, effort_limit=np.full(n, limit), continuous=np.zeros(n, dtype=bool),
        joint_names=names or tuple(f"joint{k}" for k in range(n)), period=3.0 / (rows - 1),
    )  # fmt: skip
    return Run(**{**record, **fields})


def png_size(path):
    content = path.read_bytes()
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    return struct.unpack(">II", content[16:24])


def drawn(draw, monkeypatch):
    """The matplotlib figure that the call saves."""
    from matplotlib.figure import Figure

    figures = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda figure, *a, **k: (figures.append(figure), save(figure, *a, **k))[1])
    draw()
    return figures[0]


def drawn_figure(run, path, monkeypatch, **options):
    """The matplotlib figure that plot_tracking saves."""
    return drawn(lambda: plot_tracking(run, path, **options), monkeypatch)


def curve(axes, color):
    return next(line for line in axes.lines if line.get_color() == color).get_ydata()


@pytest.mark.parametrize("n", [1, 2, 7, 30])
def test_any_number_of_joints_gives_a_picture_that_grows_with_them(n, tmp_path):
    path = plot_tracking(sinusoid_run(n), tmp_path / "new" / "tracking.png")
    width, height = png_size(path)
    assert width == 1560
    assert height == pytest.approx(120 * (1.15 + 1.5 * n), abs=1)
    assert [entry.name for entry in path.parent.iterdir()] == ["tracking.png"]  # no temporary file stays


def test_curves_are_those_of_the_chosen_start(tmp_path, monkeypatch):
    from nbs_pin.reports.plotting import ACTUAL, ERROR, TORQUE

    run = sinusoid_run(2, batch=(3,))
    run.q[:, 2] += 0.5
    figure = drawn_figure(run, tmp_path / "a.png", monkeypatch, start=2)
    position, error, torque = figure.axes[3:6]  # the second joint's row
    np.testing.assert_array_equal(curve(position, ACTUAL), run.q[:, 2, 1])
    np.testing.assert_allclose(curve(error, ERROR), np.abs(run.q - run.q_ref)[:, 2, 1], rtol=1e-12)
    np.testing.assert_array_equal(curve(torque, TORQUE)[:-1], run.tau[:-1, 2, 1])


def test_error_of_a_continuous_joint_is_wrapped(tmp_path, monkeypatch):
    from nbs_pin.reports.plotting import ERROR

    run = sinusoid_run(2, continuous=np.array([True, False]))
    run.q[:] += 2.0 * np.pi
    figure = drawn_figure(run, tmp_path / "a.png", monkeypatch)
    assert curve(figure.axes[1], ERROR).max() == pytest.approx(0.3)
    assert curve(figure.axes[4], ERROR).min() > 2.0 * np.pi


def test_saturated_stretches_are_where_the_asked_torque_exceeds_the_limit(tmp_path, monkeypatch):
    run = sinusoid_run(1)
    figure = drawn_figure(run, tmp_path / "a.png", monkeypatch)
    spans = [path.get_extents() for path in figure.axes[2].collections[0].get_paths()]
    inside = np.zeros(len(run.t), dtype=bool)
    for span in spans:
        inside |= (run.t >= span.x0) & (run.t < span.x1)
    np.testing.assert_array_equal(inside[:-1], (np.abs(run.tau_command[:, 0]) > 5.0)[:-1])
    assert f"{inside.mean():.0%}"[:-1] in figure.legends[0].texts[2].get_text()


def test_limits_are_drawn_when_the_torque_comes_near_and_named_otherwise(tmp_path, monkeypatch):
    near = drawn_figure(sinusoid_run(1), tmp_path / "a.png", monkeypatch).axes[2]
    assert {-5.0, 5.0} <= {line.get_ydata()[0] for line in near.lines}
    far = drawn_figure(sinusoid_run(1, limit=80.0), tmp_path / "b.png", monkeypatch).axes[2]
    assert [text.get_text() for text in far.texts] == ["limit ±80 (peak 10 %)"]
    none = drawn_figure(sinusoid_run(1, limit=np.inf), tmp_path / "c.png", monkeypatch).axes[2]
    assert [text.get_text() for text in none.texts] == ["no limit"]


def test_odd_runs_are_drawn(tmp_path):
    exact = sinusoid_run(1)
    exact.q[:] = exact.q_ref  # log 0
    plot_tracking(exact, tmp_path / "exact.png")
    plot_tracking(sinusoid_run(1, rows=2), tmp_path / "short.png")
    diverged = sinusoid_run(1)
    diverged.q[200:] = np.nan
    plot_tracking(diverged, tmp_path / "diverged.png")
    named = sinusoid_run(1, names=("$\\frac{$",), robot="a/$b_$.urdf", info={"controller": "x" * 80})
    plot_tracking(named, tmp_path / "named.png")


def test_a_start_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(ArgumentError, match="starts 0 to 2"):
        plot_tracking(sinusoid_run(1, batch=(3,)), tmp_path / "a.png", start=3)
    assert not list(tmp_path.iterdir())


def test_thinning_keeps_ends_order_and_every_spike():
    rng = np.random.default_rng(3)
    t = np.linspace(0.0, 1.0, 100_003)
    y = rng.normal(size=t.size)
    spikes = rng.choice(t.size, 5, replace=False)
    y[spikes] = [50.0, -60.0, 70.0, -80.0, 90.0]
    t_thin, y_thin = thin(t, y)
    assert len(t_thin) <= 4002
    assert (np.diff(t_thin) > 0.0).all()
    assert set(y[spikes]) <= set(y_thin)
    assert (t_thin[0], t_thin[-1]) == (t[0], t[-1])


def test_stretches_cover_exactly_the_flags():
    flags = np.random.default_rng(0).random(500) < 0.5
    covered = np.zeros_like(flags)
    for begin, end in stretches(flags):
        assert not covered[begin:end].any()
        covered[begin:end] = True
    np.testing.assert_array_equal(covered, flags)
