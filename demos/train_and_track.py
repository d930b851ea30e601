"""See a controller learn: error, torque and certificate before and after, and the picture out/demo/train/learning.png.

Training changes the weights of the potential and the damping and the gains S, Λ and D₀, through the closed loop with
the arm's torque limits. Every value of them is stable (docs/theory.md §2), so nothing has to be checked afterwards;
this demo checks all the same that V never rises under the trained controller on motions it never saw.
"""

from pathlib import Path

import numpy as np

import nbs_pin as nbs
from nbs_pin.reports.charts import plot_training

PERIOD = 0.005


def main(arm: str = "two_link", epochs: int = 60) -> dict[str, float]:
    """Trains on sinusoids, compares on twenty fresh starts; held-out share, median times [s], largest rise of V."""
    robot = nbs.load_robot(arm)
    plant = nbs.DynamicsPlant(nbs.PinocchioDynamics(robot))
    references = [nbs.Sinusoid.for_robot(robot, frequency) for frequency in (0.5, 1.0, 2.0)]
    untrained = nbs.NeuralBackstepping.for_robot(robot, period=PERIOD)
    training = nbs.train(
        untrained, plant, references, starts=10, start_error=0.3, period=PERIOD, epochs=epochs, progress=True
    )

    starts = references[0](0.0).q + np.random.default_rng(1).uniform(-0.3, 0.3, (20, robot.nv))
    before, after = (
        nbs.simulate(plant, law, references[0], 1.5, PERIOD, q0=starts, plant_step=PERIOD)
        for law in (untrained, training.controller)
    )
    folder = Path("out") / "demo" / "train"
    plot_training(training.history, training.held_out, training.best_epoch, before, after, folder / "learning.png")
    nbs.save(training.controller, folder / "controller.nbs")

    best = training.best_epoch
    share = training.held_out[best] / training.held_out[0]
    medians = [float(np.median(nbs.metrics.convergence_time(run))) for run in (before, after)]
    print(f"{arm}: {epochs} epochs in {training.seconds:.1f} s lower the held-out cost by {1.0 - share:.0%};")
    print(f"the error of a fresh start is below 0.1 rad after {medians[0]:.3f} s before, {medians[1]:.3f} s after.")
    rise = storage_rise(plant, training.controller, references[0], starts)
    print(f"Without torque limits V of the trained controller falls: from instant to instant by {-rise:.1e} or more.")
    print(f"Open {folder / 'learning.png'}; track with it: nbs-pin track {arm} --controller {folder}/controller.nbs")
    return {"share": float(share), "before": medians[0], "after": medians[1], "rise": rise}


def storage_rise(plant: nbs.Plant, law: nbs.NeuralBackstepping, reference: nbs.Sinusoid, starts: np.ndarray) -> float:
    """Largest rise of V between two instants ÷ V at the start, sampled finely and without torque limits."""
    run = nbs.simulate(plant, law, reference, 0.3, 0.0005, q0=starts, effort_limit=np.inf)
    storage = law.storage(run.q, run.v, run.q_ref, run.v_ref)
    return float((np.diff(storage, axis=0) / storage[0]).max())


if __name__ == "__main__":
    main()
