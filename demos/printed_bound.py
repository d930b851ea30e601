"""The error bound that the paper's Theorem 3 prints, broken by a switching torque; the certified one holds.

What to see: one joint of 1 kg·m² without gravity, S = ¼, Λ = 1, D = ½, ψ = 0. The printed bound is true of where the
error settles under constant torques. An adversary that follows the gradient of the error through the loop finds a
torque, of the same size but switching, under which the error passes it; it stays below what `certify` proves
(docs/theory.md §5).
"""

import tempfile
from pathlib import Path

import numpy as np
import torch

import nbs_pin as nbs

ARM = """<robot name="one_joint"><link name="base"/><link name="wheel"><inertial><mass value="1"/>
  <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <joint name="axle" type="revolute"><parent link="base"/><child link="wheel"/><axis xyz="0 0 1"/>
  <limit lower="-3" upper="3" effort="100" velocity="100"/></joint></robot>"""
LARGEST = 0.1  # N·m


def law() -> nbs.NeuralBackstepping:
    """The paper's law with constant gains: both networks give zero."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "one_joint.urdf"
        file.write_text(ARM)
        model = nbs.PinocchioDynamics(nbs.load_robot(file))
    potential, damping = nbs.Potential([[0.25]]), nbs.Damping(1, floor=[[0.5]])
    made = nbs.NeuralBackstepping(model, potential, damping)
    with torch.no_grad():
        for network in (potential.network, damping.diagonal, damping.lower):
            for weights in network.parameters():
                weights.zero_()
    return made


def main(duration: float = 28.0) -> dict[str, float]:
    """Prints and returns the printed bound, the certified one, and the errors under a constant and the worst torque."""
    controller, posture = law(), nbs.Hold([0.0])
    certificate = nbs.certify(controller, [LARGEST])
    plant = nbs.DynamicsPlant(controller.dynamics)
    steady = nbs.simulate(
        plant, controller, posture, duration, 0.002, disturbance=nbs.ConstantTorque([LARGEST]), q0=[0.0]
    )
    found = nbs.attack(controller, [LARGEST], reference=posture, duration=duration, period=0.002, rounds=2, starts=1)
    errors = {
        "constant": float(np.abs(nbs.metrics.error(steady)[-1]).max()),
        "printed": certificate.printed_error,
        "found": found.error,
        "certified": certificate.error,
    }
    print(f"constant torque of {LARGEST} N·m: ‖z1‖ settles at {errors['constant']:.4f} rad")
    print(f"bound printed in the paper:       {errors['printed']:.4f} rad")
    print(f"{found.found_by} of {LARGEST} N·m: ‖z1‖ reaches {errors['found']:.4f} rad")
    print(f"bound that certify proves:        {errors['certified']:.4f} rad, {certificate.label}")
    return errors


if __name__ == "__main__":
    main()
