"""Faults are injected into a loop that has a certificate, and the monitor says what is wrong.

What to see: without a fault the promise is kept. A torque larger than what was certified, a load that the law does not
know of, and a motor that saturates are each named by the assumption that they break, and no alarm is raised for the
honest run.
"""

from dataclasses import replace

import numpy as np

import nbs_pin as nbs

LARGEST = 5.0  # N·m on every joint


def main(duration: float = 2.0) -> dict[str, str]:
    """Prints and returns the verdict of each run."""
    robot = nbs.load_robot("two_link")
    law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    certificate = nbs.certify(law, [LARGEST, LARGEST], reference=reference, duration=duration, period=0.001)
    print(certificate)
    loaded = robot.with_payload("link2", 1.0, com=[0.0, 0.0, -0.5])

    def run(arm: nbs.Robot = robot, torque: float = LARGEST, limit: float = np.inf) -> nbs.Run:
        plant = nbs.DynamicsPlant.for_robot(arm)
        wave = nbs.SquareWave(np.full(2, torque), frequency=3.0)
        recorded = nbs.simulate(
            plant, law, reference, duration, 0.001, disturbance=wave, effort_limit=limit, check=False
        )
        # A log names the arm that its controller believes in, not the one that hangs there.
        return replace(recorded, robot_sha256=robot.sha256)

    cases = {
        "honest": run(),
        "torque too large": run(torque=3.0 * LARGEST),
        "unknown load": run(arm=loaded),
        "weak motor": run(limit=25.0),
    }
    verdicts = {name: nbs.monitor(recorded, certificate).verdict for name, recorded in cases.items()}
    for name, verdict in verdicts.items():
        print(f"{name:17} {verdict}")
    return verdicts


if __name__ == "__main__":
    main()
