"""A plain network from motion to torque, without any mechanics: the baseline of the models with structure."""

import copy
import math

import numpy as np
import torch
from jaxtyping import Float

from nbs_pin.dynamics.features import JointFeatures
from nbs_pin.dynamics.tanh_network import TanhNetwork
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.network_equations import deviation_of

HELD_OUT = 0.2
"""Share of the trajectories that choose the step whose parameters are kept."""
_BATCH, _RATE, _DECAY, _CHECKS = 256, 2e-3, 1.0, 60


class InverseMlp:
    """τ(q, v, v̇) by tanh layers on the sine and cosine of q, v, v̇ and, for friction, tanh(v/transition).

    Inputs and outputs of the network are in units of their deviations in the data, about their means.
    """

    def __init__(
        self, data: Dataset, transition: float | None, widths: tuple[int, ...], generator: torch.Generator
    ) -> None:
        self.features, self.transition = JointFeatures(data.prismatic.tolist()), transition
        raw = self._raw(data.q, data.v, data.a)
        self.inputs = np.stack([raw.mean(0), deviation_of(raw)])
        self.outputs = np.stack([data.tau.mean(0), deviation_of(data.tau)])
        self.network = TanhNetwork((raw.shape[1], *widths, data.nv), generator)

    def torque(
        self, q: Float[np.ndarray, "rows n"], v: Float[np.ndarray, "rows n"], a: Float[np.ndarray, "rows n"]
    ) -> Float[np.ndarray, "rows n"]:
        """Torque of the motors [N·m]."""
        with torch.no_grad():
            return self.outputs[0] + self.outputs[1] * self.network(self.scaled(q, v, a)).numpy()

    def scaled(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> Float[torch.Tensor, "rows inputs"]:
        """Inputs of the network."""
        return torch.from_numpy((self._raw(q, v, a) - self.inputs[0]) / self.inputs[1])

    def _raw(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> Float[np.ndarray, "rows inputs"]:
        friction = [] if self.transition is None else [np.tanh(v / self.transition)]
        return np.concatenate([self.features(torch.from_numpy(q)).numpy(), v, a, *friction], axis=1)


def fit_mlp(
    data: Dataset,
    seed: int = 0,
    *,
    transition: float | None = None,
    steps: int = 4_000,
    widths: tuple[int, ...] = (128, 128),
) -> InverseMlp:
    """The network with the least squared torque error, each joint's in units of its deviation.

    Adam on batches with weight decay, its step falling along a cosine; the parameters that explain a fifth of the
    trajectories best are kept. Widths and decay are the best of a dozen tried on three_link and ur5.

    Args:
        data: Motions of the arm, at least two trajectories.
        seed: Seed of split, first parameters and batches.
        transition: Speed at which the friction in the data changes sign [rad/s]; None for none.
        steps: Steps of Adam.
        widths: Sizes of the hidden layers.
    """
    train, checked = data.split(HELD_OUT, seed)
    generator = torch.Generator().manual_seed(seed)
    found = InverseMlp(train, transition, widths, generator)
    network, deviation = found.network, found.outputs[1]
    x, y = found.scaled(train.q, train.v, train.a), torch.from_numpy((train.tau - found.outputs[0]) / deviation)
    optimiser = torch.optim.AdamW(network.parameters(), lr=_RATE, weight_decay=_DECAY)
    least, best = math.inf, copy.deepcopy(network.state_dict())
    for step in range(steps):
        optimiser.param_groups[0]["lr"] = _RATE * 0.5 * (1.0 + math.cos(math.pi * step / steps))
        rows = torch.randint(len(x), (min(_BATCH, len(x)),), generator=generator)
        optimiser.zero_grad()
        (network(x[rows]) - y[rows]).square().mean().backward()
        optimiser.step()
        if (step + 1) % max(1, steps // _CHECKS) == 0:
            error = np.square((found.torque(checked.q, checked.v, checked.a) - checked.tau) / deviation).mean()
            if error < least:
                least, best = float(error), copy.deepcopy(network.state_dict())
    network.load_state_dict(best)
    network.requires_grad_(False)
    return found
