"""A log as an arm writes it, in CSV with encoder steps and torque noise, becomes a model that a law can use.

What to see: the log is recorded here, from a Panda with joint friction whose encoders have 16 bits and whose torque
sensors are off by 0.2 N·m, and written as a table of time, positions and torques. Read back, it is differentiated, and
inertias and friction are identified in the known geometry. What the model leaves unexplained is about the noise of the
torque sensors; the rest comes from accelerations that are second differences of encoder steps.
"""

from pathlib import Path

import numpy as np

import nbs_pin as nbs

NOISE = 0.2  # N·m


def main(arm: str = "panda", samples: int = 2000, out: Path = Path("out/demo/log")) -> dict[str, float]:
    """Returns the unexplained torque over the noise, and the error of the identified friction [N·m·s/rad]."""
    robot = nbs.load_robot(arm).with_friction(viscous=0.5, coulomb=0.3)
    noise = nbs.Noise(encoder=2.0**-16, torque=NOISE)
    recorded = nbs.collect(robot, samples=samples, seed=0, noise=noise, friction=True, sampling=0.01)

    out.mkdir(parents=True, exist_ok=True)
    names = [f"{what}_{joint}" for what in ("q", "tau") for joint in robot.joint_names]
    table = np.column_stack([recorded.t, recorded.trajectory, recorded.q, recorded.tau])
    header = ",".join(["t", "trajectory", *names])
    np.savetxt(out / "log.csv", table, delimiter=",", header=header, comments="", fmt="%.8g")

    data = nbs.load_log(out / "log.csv", robot=robot)
    model = nbs.fit(data, "identified", robot=robot, friction=True, seed=0)
    assert model.friction is not None
    explained = nbs.inverse_dynamics(model, data.q, data.v, data.a) + model.friction.torque(data.v)
    left = float(np.sqrt(np.mean((data.tau - explained) ** 2)))
    friction = float(np.abs(model.friction.viscous - 0.5).max())
    print(f"{data}: unexplained torque {left:.3f} N·m RMS, noise of the sensors {NOISE} N·m")
    print(f"viscous friction of 0.5 N·m·s/rad identified within {friction:.3f}")
    return {"over_noise": left / NOISE, "friction": friction}


if __name__ == "__main__":
    main()
