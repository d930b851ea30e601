"""Forty starts at once: one call to `simulate`, one array with a start axis, every number per start.

What to see: whatever corner of a box of ±1 rad a two-link arm starts in, it converges; the histogram shows when. The
storage function V of the law falls along every one of the trajectories, as the theory says (docs/theory.md §2): the
largest rise that is printed is rounding.
"""

import numpy as np

import nbs_pin as nbs


def main(starts: int = 40, duration: float = 2.0, seed: int = 0) -> nbs.Run:
    """Simulates, prints the histogram and returns the run, its arrays of shape (rows, starts, joints)."""
    robot = nbs.load_robot("two_link")
    controller = nbs.NeuralBackstepping.for_robot(robot, period=0.002, seed=seed)
    reference = nbs.Sinusoid.for_robot(robot)
    offsets = np.random.default_rng(seed).uniform(-1.0, 1.0, (starts, robot.nv))
    run = nbs.simulate(
        nbs.DynamicsPlant(nbs.PinocchioDynamics(robot)),
        controller,
        reference,
        duration,
        0.002,
        q0=reference(0.0).q + offsets,
        effort_limit=np.inf,  # V falls where no torque is cut off
        progress=True,
    )
    times = nbs.metrics.convergence_time(run)
    counts, edges = np.histogram(times, bins=8)
    for count, low, high in zip(counts, edges, edges[1:], strict=False):
        print(f"{low:5.3f} – {high:5.3f} s  {'█' * count}")
    storage = controller.storage(run.q, run.v, run.q_ref, run.v_ref)
    rise = np.diff(storage, axis=0).max() / storage[0].max()
    print(
        f"{starts} starts, all within 0.1 rad after {times.max():.2f} s; V rises by at most {rise:.0e} V(0) in a step"
    )
    return run


if __name__ == "__main__":
    main()
