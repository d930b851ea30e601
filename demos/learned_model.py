"""A model learned from motions, against Pinocchio's: no length, no axis and no mass is given.

What to see: from some hundred samples a chain, which is told only the order of the joints, is the arm itself to
rounding; a plain network of the same data is not. On the learned chain the law tracks as on the exact model.
"""

import nbs_pin as nbs


def main(arm: str = "three_link", samples: int = 600, iterations: int = 30) -> dict[str, float]:
    """Prints the errors of both models, and returns the relative error of the torque and the tracking error [rad]."""
    robot = nbs.load_robot(arm)
    truth = nbs.PinocchioDynamics(robot)
    data = nbs.collect(robot, samples=samples, seed=0)
    models = {
        "chain": nbs.fit(data, "chain", robot=robot, seed=0),
        "network": nbs.fit(data, "unconstrained", robot=robot, seed=0, iterations=iterations),
    }
    found = {name: nbs.compare(model, truth, samples=300, motions=0).inverse for name, model in models.items()}
    for name, error in found.items():
        print(f"{name:8} {models[name]}: torque off by {100.0 * error:.2g} %")
    law = nbs.NeuralBackstepping.for_robot(robot, dynamics=models["chain"])
    run = nbs.simulate(nbs.MujocoPlant(robot), law, nbs.Sinusoid.for_robot(robot), 2.0, 0.001)
    found["tracking"] = float(nbs.metrics.rms_error(run, after=1.0).max())
    print(f"tracking on the learned chain: {found['tracking']:.1e} rad RMS at the worst joint")
    return found


if __name__ == "__main__":
    main()
