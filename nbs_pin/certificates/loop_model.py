"""Law and model as a monitor evaluates them at readings of encoders: as machine code where there are kernels."""

import copy
import threading
from abc import ABC, abstractmethod

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.certificates.energy_balance import LoopSamples, balance
from nbs_pin.controllers.controller import MemorylessController
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.dynamics.equations import inverse_dynamics
from nbs_pin.kernels import periods, watching as at
from nbs_pin.kernels.laws import pack_tree_law
from nbs_pin.kernels.layout import LAW, LawCode
from nbs_pin.kernels.periods import compile_periods
from nbs_pin.kernels.threads import Scratch
from nbs_pin.kernels.watching import compile_watching


class LoopModel(ABC):
    """The signals of three samples, and V at the means of a window (`kernels/watching.py`)."""

    @staticmethod
    def of(controller: LyapunovLaw) -> "LoopModel":
        """Machine code if the law and its model have kernels, else the law itself."""
        tree = controller.dynamics.packed_tree()
        if tree is None or not controller.packable:
            return PlainModel(controller)
        law = controller.packed_law()
        return CompiledModel(controller) if law.layout[LAW] == LawCode.BACKSTEPPING else PlainModel(controller)

    @abstractmethod
    def storage(self, sample: Float[np.ndarray, "7 n"]) -> float:
        """V [J]."""

    @abstractmethod
    def period(
        self, before: Float[np.ndarray, "7 n"], after: Float[np.ndarray, "7 n"], h: float, last: float
    ) -> tuple[Float[np.ndarray, " terms"], Float[np.ndarray, "4 n"]]:
        """The energy balance between two samples h [s] apart (`periods.period_terms`); last: V of the first [J]."""

    @abstractmethod
    def observe(self, samples: Float[np.ndarray, "3 7 n"], period: float) -> Float[np.ndarray, "8 n"]:
        """The signals of the middle sample; they are `period` [s] apart."""

    @abstractmethod
    def centre(
        self, mean: Float[np.ndarray, "8 n"], q: JointArray, resolution: JointArray, width: float
    ) -> tuple[Float[np.ndarray, "4"], JointArray]:
        """Φ, its error, ½z̄2ᵀM z̄2, ½δᵀ|M|δ [J], and |M|r [kg·m²·rad].

        q: the reading at the centre of the window [rad]; width: half its length [s].
        """


class CompiledModel(LoopModel):
    """A backstepping law on a rigid tree."""

    def __init__(self, controller: LyapunovLaw) -> None:
        compile_watching()
        compile_periods()
        law, tree = controller.packed_law(), controller.dynamics.packed_tree()
        assert tree is not None
        self._packed, self._scratch = tuple(pack_tree_law(law, tree)), Scratch(at.watch_workspace(law, tree))
        self._n = controller.nv

    def storage(self, sample: Float[np.ndarray, "7 n"]) -> float:
        """As in `LoopModel`."""
        work = self._scratch.take()
        value = float(periods.storage(sample, *self._packed, work))
        self._scratch.give(work)
        return value

    def period(
        self, before: Float[np.ndarray, "7 n"], after: Float[np.ndarray, "7 n"], h: float, last: float
    ) -> tuple[Float[np.ndarray, " terms"], Float[np.ndarray, "4 n"]]:
        """As in `LoopModel`."""
        terms, vectors, work = np.empty(periods.TERMS), np.empty((periods.VECTORS, self._n)), self._scratch.take()
        periods.period_terms(before, after, h, last, *self._packed, work, terms, vectors)
        self._scratch.give(work)
        return terms, vectors

    def observe(self, samples: Float[np.ndarray, "3 7 n"], period: float) -> Float[np.ndarray, "8 n"]:
        """As in `LoopModel`."""
        out, work = np.empty((at.SIGNALS, self._n)), self._scratch.take()
        at.observe(samples, period, *self._packed, work, out)
        self._scratch.give(work)
        return out

    def centre(
        self, mean: Float[np.ndarray, "8 n"], q: JointArray, resolution: JointArray, width: float
    ) -> tuple[Float[np.ndarray, "4"], JointArray]:
        """As in `LoopModel`."""
        out, share, work = np.empty(at.CENTRE), np.empty(self._n), self._scratch.take()
        at.centre(mean, q, resolution, width, *self._packed, work, out, share)
        self._scratch.give(work)
        return out, share


class PlainModel(LoopModel):
    """Any law with any model, as it is written."""

    def __init__(self, controller: LyapunovLaw) -> None:
        self._controller = controller
        self._of_thread: dict[int, tuple[LyapunovLaw, MemorylessController]] = {}
        self._own()

    def _own(self) -> tuple[LyapunovLaw, MemorylessController]:
        """The law and its machine code, copied for the thread that calls: models keep scratch space."""
        own = self._of_thread.get(threading.get_ident())
        if own is None:
            law = copy.deepcopy(self._controller)
            compiled = law.compile()
            own = law, compiled if isinstance(compiled, MemorylessController) else law
            self._of_thread[threading.get_ident()] = own
        return own

    def storage(self, sample: Float[np.ndarray, "7 n"]) -> float:
        """As in `LoopModel`."""
        return float(self._own()[0].storage(*sample[at.Q : at.V_REF + 1]))

    def period(
        self, before: Float[np.ndarray, "7 n"], after: Float[np.ndarray, "7 n"], h: float, last: float
    ) -> tuple[Float[np.ndarray, " terms"], Float[np.ndarray, "4 n"]]:
        """As in `LoopModel`."""
        value, t, (law, quick) = self.storage(after), np.array([0.0, h]), self._own()
        first, second = (LoopSamples(t[k : k + 1], *x[:, None]) for k, x in enumerate((before, after)))
        flow = balance(law, first, second, np.array([value - last]), quick)
        numbers = (x[0] for x in flow[:6])
        return np.array([value, *numbers, *flow.state_norms[0]]), np.concatenate(flow[6:10])

    def observe(self, samples: Float[np.ndarray, "3 7 n"], period: float) -> Float[np.ndarray, "8 n"]:
        """As in `LoopModel`."""
        (law, quick), now = self._own(), samples[1]
        ahead = law.dynamics.difference(samples[2, at.Q], now[at.Q])
        behind = law.dynamics.difference(now[at.Q], samples[0, at.Q])
        v, a = 0.5 * (ahead + behind) / period, (ahead - behind) / period**2
        torque = 0.5 * (samples[0, at.TAU] + now[at.TAU])
        asked = quick.torque(now[at.Q], now[at.V], now[at.Q_REF], now[at.V_REF], now[at.A_REF])
        lag = now[at.COMMAND] - np.clip(
            now[at.COMMAND], *np.sort([asked, self._ahead(now, samples[2], period)], axis=0)
        )
        e = law.errors(now[at.Q], v, now[at.Q_REF], now[at.V_REF], now[at.A_REF])
        unexplained = inverse_dynamics(law.dynamics, now[at.Q], v, a) - torque
        return np.array([unexplained, torque, lag, asked, e.z1, e.z2, v, now[at.Q]])

    def _ahead(self, now: Float[np.ndarray, "7 n"], after: Float[np.ndarray, "7 n"], h: float) -> JointArray:
        """The law a period ahead, at the state predicted with the reference's acceleration [N·m]."""
        q, v, q_ref, v_ref, a = now[at.Q : at.A_REF + 1]
        ahead = (x + h * (rate + 0.5 * h * a) for x, rate in ((q, v), (q_ref, v_ref)))
        q, q_ref = ahead
        return np.asarray(self._own()[1].torque(q, v + h * a, q_ref, v_ref + h * a, after[at.A_REF]))

    def centre(
        self, mean: Float[np.ndarray, "8 n"], q: JointArray, resolution: JointArray, width: float
    ) -> tuple[Float[np.ndarray, "4"], JointArray]:
        """As in `LoopModel`."""
        law, _ = self._own()
        value, gradient, bend = law.potential_terms(mean[at.Z1], 0.5 * resolution)
        error = resolution / width + law.rate_like(q) * np.abs(bend)
        out, share = np.empty(at.CENTRE), np.empty(len(q))
        mass = np.ascontiguousarray(law.dynamics.mass_matrix(q))
        at.settle(mean[at.Z2], mass, np.ascontiguousarray(gradient), error, resolution, out, share)
        out[at.PHI] = value
        return out, share
