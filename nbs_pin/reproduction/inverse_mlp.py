"""A plain network from motion to torque, with no mechanics in it: what structure has to beat."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from nbs_pin.dynamics.features import JointFeatures
from nbs_pin.dynamics.tanh_network import TanhNetwork
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.network_equations import deviation_of

STEPS, WIDTHS = 4_000, (128, 128)
"""Steps of Adam, and hidden layers, unless others are asked for."""
HELD_OUT = 0.2
"""Share of the trajectories that choose the step it ends with."""
_BATCH, _RATE, _DECAY, _CHECKS = 256, 2e-3, 1.0, 60


@dataclass(frozen=True, eq=False)
class InverseMlp:
    """τ(q, v, v̇) by tanh layers on the sine and cosine of q, v, v̇ and, for friction, tanh(v/transition)."""

    network: TanhNetwork
    features: JointFeatures
    transition: float | None
    """Speed at which friction turns [rad/s]; None where none is expected."""
    inputs: Float[np.ndarray, "2 inputs"]
    """Mean and deviation of each input, which the network sees in these units."""
    outputs: Float[np.ndarray, "2 n"]
    """The same of the torques [N·m]."""

    def torque(
        self, q: Float[np.ndarray, "rows n"], v: Float[np.ndarray, "rows n"], a: Float[np.ndarray, "rows n"]
    ) -> Float[np.ndarray, "rows n"]:
        """Torque of the motors [N·m]."""
        mean, deviation = self.inputs
        with torch.no_grad():
            x = torch.from_numpy((_inputs(self.features, self.transition, q, v, a) - mean) / deviation)
            return self.outputs[0] + self.outputs[1] * self.network(x).numpy()


def fit_mlp(
    data: Dataset,
    seed: int = 0,
    *,
    transition: float | None = None,
    steps: int = STEPS,
    widths: tuple[int, ...] = WIDTHS,
) -> InverseMlp:
    """The network with the least squared torque error, each joint's in units of its deviation.

    Adam on batches with decay of the weights, its step falling along a cosine; the parameters that explain a fifth of
    the trajectories best are kept. Widths and decay are the best of a dozen tried on three_link and ur5.
    transition: of friction in the data [rad/s], None for none. Raises ArgumentError for one trajectory only.
    """
    train, checked = data.split(HELD_OUT, seed)
    features, generator = JointFeatures(data.prismatic.tolist()), torch.Generator().manual_seed(seed)
    raw = _inputs(features, transition, train.q, train.v, train.a)
    inputs = np.stack([raw.mean(0), deviation_of(raw)])
    outputs = np.stack([train.tau.mean(0), deviation_of(train.tau)])
    network = TanhNetwork((raw.shape[1], *widths, data.nv), generator)
    found = InverseMlp(network, features, transition, inputs, outputs)
    x, y = torch.from_numpy((raw - inputs[0]) / inputs[1]), torch.from_numpy((train.tau - outputs[0]) / outputs[1])
    optimiser = torch.optim.AdamW(network.parameters(), lr=_RATE, weight_decay=_DECAY)
    least, best = math.inf, {name: p.clone() for name, p in network.state_dict().items()}
    for step in range(steps):
        optimiser.param_groups[0]["lr"] = _RATE * 0.5 * (1.0 + math.cos(math.pi * step / steps))
        rows = torch.randint(len(x), (min(_BATCH, len(x)),), generator=generator)
        optimiser.zero_grad()
        (network(x[rows]) - y[rows]).square().mean().backward()
        optimiser.step()
        if (step + 1) % max(1, steps // _CHECKS) == 0:
            error = (found.torque(checked.q, checked.v, checked.a) - checked.tau) / outputs[1]
            if np.square(error).mean() < least:
                least = float(np.square(error).mean())
                best = {name: p.clone() for name, p in network.state_dict().items()}
    network.load_state_dict(best)
    network.requires_grad_(False)
    return found


def _inputs(
    features: JointFeatures, transition: float | None, q: np.ndarray, v: np.ndarray, a: np.ndarray
) -> Float[np.ndarray, "rows inputs"]:
    """What the network sees, before its units."""
    columns = [features(torch.from_numpy(q)).numpy(), v, a]
    return np.concatenate(columns if transition is None else [*columns, np.tanh(v / transition)], axis=1)
