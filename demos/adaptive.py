"""A Panda picks up two kilograms that nobody told its law of, and puts them down again; an adaptive law finds them out.

What to see: with the load, the law with a fixed model is off by hundredths of a radian, the one that adapts by
less than a thousandth. Within seconds it knows the mass to a few percent and where its centre is, and it forgets the
load when it is gone (docs/theory.md §10). In the replay the ball is the load, and the chart "estimates" is what the law
believes.
"""

from pathlib import Path

import numpy as np

import nbs_pin as nbs

OUT = Path("out/demo/adaptive")
MASS = 2.0  # kg


def main(duration: float = 20.0) -> dict[str, float]:
    """Returns the error of each law with the load [rad], and the masses believed with it and at the end [kg]."""
    robot = nbs.load_robot("panda")
    picked, put_down = 0.25 * duration, 0.7 * duration  # s
    bare, loaded = nbs.MujocoPlant(robot), nbs.MujocoPlant(robot.with_payload("panda_hand_tcp", MASS))
    plant = nbs.ChangingPlant(bare, [(picked, loaded), (put_down, bare)])

    fixed = nbs.NeuralBackstepping.for_robot(robot)
    adaptive = nbs.AdaptiveLaw(fixed, ["load", "friction", "rotors"])  # the same law, and a model that learns
    motion, found, runs = nbs.Sinusoid.for_robot(robot), {}, {}
    for name, law in {"fixed": fixed, "adaptive": adaptive}.items():
        run = runs[name] = nbs.simulate(plant, law, motion, duration, 0.001)
        carrying = run.head(round(put_down / run.period))
        found[name] = float(nbs.metrics.rms_error(carrying, after=0.5 * (picked + put_down)).max())
        print(f"{name:9} worst joint with the load: {found[name]:.1e} rad RMS")

    run = runs["adaptive"]
    believed = adaptive.estimate(run.estimates)
    row = round(put_down / run.period) - 1
    found |= {"with": float(believed.load_mass[row]), "after": float(believed.load_mass[-1])}
    centre = np.linalg.norm(believed.load_centre[row])
    print(f"believed before it is put down: {found['with']:.3f} kg, the centre off by {1e3 * centre:.1f} mm")
    print(f"believed at the end: {found['after']:.3f} kg")

    # What the plant carried is for those who look: pictures and replays show it beside what was learned.
    load = {"mass_kg": MASS, "link": "panda_hand_tcp", "from_s": picked, "until_s": put_down}
    run.info["loads"] = [load]
    nbs.plot_estimates(run, OUT / "estimates.png")
    page = nbs.replay(run, OUT / "replay.html")
    print(f"Open {page} in a browser.")
    return found


if __name__ == "__main__":
    main()
