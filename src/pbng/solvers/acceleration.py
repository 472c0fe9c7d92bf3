"""Accelerations of a fixed-point iteration x <- G(x), for PBNG one sweep (section 7.3 and docs/method.md).

Each is a frozen description; ``start`` makes the state of one solve. Only free vertices are touched: the arrays given
are the leading, free part of a flat position array.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import prange

from pbng.errors import InputError
from pbng.jit import kernel

CHUNK = 4096  # entries a thread takes at a time; sums are formed chunk by chunk, so that their rounding is fixed


class FixedPoint(Protocol):
    """What is accelerated; arrays are flat positions, of which the first ``n_free`` entries are free."""

    n_free: int

    def apply(self, x: np.ndarray, omega: float = 1.0) -> None:
        """x <- G(x), each node's step relaxed by omega."""

    def energy(self, x: np.ndarray) -> float:
        """Potential energy [J] in float64."""


class Iteration(Protocol):
    """The state of one accelerated solve."""

    def step(self, x: np.ndarray) -> None:
        """One iteration, in place."""

    def settle(self, x: np.ndarray) -> None:
        """Make x a state to stop at: where energy is safeguarded, one whose energy has not risen."""


class Acceleration(Protocol):
    """Description of an acceleration."""

    def start(self, map: FixedPoint) -> Iteration:
        """Begin with an empty history."""


@dataclass(frozen=True)
class NodeSOR:
    """Classical successive over-relaxation: x_i += ω A⁻¹ f for each node in turn; ω = 1 is the plain method.

    Energy never rises for 0 < ω < 2.
    """

    omega: float = 1.7

    def __post_init__(self) -> None:
        if not 0 < self.omega < 2:
            raise InputError(f"NodeSOR: omega must lie strictly between 0 and 2, not {self.omega}")

    def start(self, map: FixedPoint) -> Iteration:
        return _Sweeps(map, self.omega)


class _Sweeps:
    def __init__(self, map: FixedPoint, omega: float) -> None:
        self.map, self.omega = map, omega

    def step(self, x: np.ndarray) -> None:
        self.map.apply(x, self.omega)

    def settle(self, x: np.ndarray) -> None:
        pass


@dataclass(frozen=True)
class SOR:
    """SOR as the paper prints it, a two-step method: x⁺ = ω (G(x) - x⁻) + x⁻. May diverge; kept for comparison."""

    omega: float = 1.7

    def start(self, map: FixedPoint) -> Iteration:
        return _TwoStep(map, lambda l: self.omega, 1.0)


@dataclass(frozen=True)
class Chebyshev:
    """Chebyshev semi-iteration as printed: x⁺ = ω_l (γ (G(x) - x) + x - x⁻) + x⁻. May diverge; for comparison."""

    rho: float = 0.95
    gamma: float = 1.7

    def __post_init__(self) -> None:
        if not 0 <= self.rho < 1:
            raise InputError(f"Chebyshev: rho must lie in [0, 1), not {self.rho}")

    def start(self, map: FixedPoint) -> Iteration:
        omega = [1.0, 1.0, 2 / (2 - self.rho**2)]

        def next_omega(l: int) -> float:
            while len(omega) <= l:
                omega.append(4 / (4 - self.rho**2 * omega[-1]))
            return omega[l]

        return _TwoStep(map, next_omega, self.gamma)


class _TwoStep:
    """x⁺ = ω_l (γ (G(x) - x) + x - x⁻) + x⁻ for l = 1, 2, ...; SOR is γ = 1 with a constant ω."""

    def __init__(self, map: FixedPoint, omega, gamma: float) -> None:
        self.map, self.omega, self.gamma, self.l = map, omega, gamma, 0
        self.before: np.ndarray | None = None

    def step(self, x: np.ndarray) -> None:
        n, real = self.map.n_free, x.dtype.type
        here = x[:n].copy()
        before = here if self.before is None else self.before
        self.map.apply(x)
        self.l += 1
        omega, gamma = real(self.omega(self.l)), real(self.gamma)
        x[:n] = omega * (gamma * (x[:n] - here) + here - before) + before
        self.before = here

    def settle(self, x: np.ndarray) -> None:
        pass


@dataclass(frozen=True)
class Anderson:
    """Anderson mixing of the last ``memory`` sweeps, taken only where it lowers the energy; never diverges.

    With f_k = G(x_k) - x_k, θ minimises |f_k - ΔF θ| and x_{k+1} = G(x_k) - ΔG θ if that is no higher than x_k, else
    G(x_k), after which the history starts afresh. An energy costs about a sweep, so once mixing has proved itself
    it is evaluated every few iterations only; if it has risen, the iteration returns to where it was last known. The
    defaults were chosen by measurement (docs/choosing.md).
    """

    memory: int = 10
    omega: float = 1.3

    def __post_init__(self) -> None:
        if not (isinstance(self.memory, int) and self.memory >= 1):
            raise InputError(f"Anderson: memory must be a whole number of at least 1, not {self.memory}")
        if not 0 < self.omega < 2:
            raise InputError(f"Anderson: omega must lie strictly between 0 and 2, not {self.omega}")

    def start(self, map: FixedPoint) -> Iteration:
        return _Mixing(map, self.memory, self.omega)


class _Mixing:
    PROBATION, EVERY = 5, 5  # mixed steps in a row that must prove good one by one; then one in so many is checked

    def __init__(self, map: FixedPoint, memory: int, omega: float) -> None:
        self.map, self.omega = map, omega
        self.energy = math.inf  # at the last checked state
        self.unchecked = 0  # steps since
        self.good = 0  # checks passed in a row
        self.rejected = 0
        self.history = MixingHistory(memory)
        self.buffers: tuple[np.ndarray, ...] = ()

    def step(self, x: np.ndarray) -> None:
        n = self.map.n_free
        if not self.buffers:
            self.buffers = np.empty_like(x), x.copy(), np.empty_like(x)  # G(x), mixed, last checked
        g, mixed, checked = self.buffers
        g[:] = x
        self.map.apply(g, self.omega)
        if self.history.push(x[:n], g[:n]):
            if self.history.mix(g[:n], mixed[:n]):
                if self.good >= self.PROBATION and self.unchecked + 1 < self.EVERY:
                    x[:] = mixed
                    self.unchecked += 1
                    return
                if self._passes(mixed):
                    x[:] = mixed
                    return
            if self.unchecked:
                g[:] = checked
                self.map.apply(g, self.omega)
            self._restart()
        x[:] = checked[:] = g
        self.energy, self.unchecked = self.map.energy(g), 0

    def settle(self, x: np.ndarray) -> None:
        if self.unchecked and not self._passes(x):
            x[:] = self.buffers[2]
            self._restart()

    def _passes(self, x: np.ndarray) -> bool:
        """Whether the energy at x has not risen since the last check; if so, x is the last checked state now."""
        energy = self.map.energy(x)
        if not energy <= self.energy:
            return False
        self.buffers[2][:] = x
        self.energy, self.unchecked, self.good = energy, 0, self.good + 1
        return True

    def _restart(self) -> None:
        self.history.restart()
        self.good, self.unchecked, self.rejected = 0, 0, self.rejected + 1


class MixingHistory:
    """The last differences of a fixed-point iteration x -> g = G(x), and the mixture that they suggest."""

    def __init__(self, memory: int) -> None:
        self.memory = memory
        self.count = -1  # differences stored since the last restart; -1: not even a first f
        self.gram, self.rhs = np.zeros((memory, memory)), np.zeros(memory)

    def restart(self) -> None:
        """Forget everything."""
        self.count = -1

    def push(self, x: np.ndarray, g: np.ndarray) -> bool:
        """Take in x and g = G(x); False if there is no difference to mix with yet."""
        if not hasattr(self, "dF"):
            n = len(x)
            self.dF, self.dG = np.zeros((self.memory, n), x.dtype), np.zeros((self.memory, n), x.dtype)
            self.f, self.g = np.zeros(n, x.dtype), np.zeros(n, x.dtype)
        first = self.count < 0
        row = max(self.count, 0) % self.memory
        self.count += 1
        kept = min(self.count, self.memory)
        sums = _difference(x, g, self.f, self.g, self.dF, self.dG, row, kept).sum(0)
        if first:
            return False
        self.gram[row, :kept] = self.gram[:kept, row] = sums[:kept]
        self.rhs[:kept] = sums[kept : 2 * kept]
        return True

    def mix(self, g: np.ndarray, out: np.ndarray) -> bool:
        """Write G(x) - ΔG θ to out, with θ the minimiser of |f - ΔF θ|; False if there is none."""
        theta = self._weights()
        if theta is not None:
            _mix(g, self.dG, theta, out)
        return theta is not None

    def _weights(self) -> np.ndarray | None:
        """θ of the least-squares problem, from its scaled normal equations with a tiny ridge; None if it has none."""
        n = min(self.count, self.memory)
        norms = np.sqrt(np.diag(self.gram)[:n])
        used = norms > 1e-12 * norms.max()  # a difference lost in rounding has no direction
        if not (np.isfinite(self.gram[:n, :n]).all() and np.isfinite(self.rhs[:n]).all() and used.any()):
            return None
        scale = np.where(used, 1 / np.where(used, norms, 1.0), 0.0)
        A = self.gram[:n, :n] * scale[:, None] * scale + 1e-12 * n * np.eye(n)
        return scale * np.linalg.lstsq(A, scale * self.rhs[:n], rcond=1e-12)[0]


@kernel
def _difference(x, g, f_before, g_before, dF, dG, row, kept):
    """Store the newest differences in ``row``; returns ΔF_row · ΔF_j, then ΔF_j · f, for j < kept, by chunks.

    Slices, here and below, because Numba's test for negative indices keeps loops over two-index arrays scalar.
    """
    n = x.size
    part = np.zeros(((n + CHUNK - 1) // CHUNK, 2 * kept))
    for chunk in prange(part.shape[0]):
        low, high = chunk * CHUNK, min(n, (chunk + 1) * CHUNK)
        here, image, f, image_before = x[low:high], g[low:high], f_before[low:high], g_before[low:high]
        df, dg = dF[row, low:high], dG[row, low:high]  # mean nothing on the first call: they are overwritten
        for i in range(high - low):
            step = image[i] - here[i]
            df[i] = step - f[i]
            f[i] = step
        for i in range(high - low):
            dg[i] = image[i] - image_before[i]
            image_before[i] = image[i]
        for j in range(kept):
            other = dF[j, low:high]
            a, b = 0.0, 0.0
            for i in range(high - low):
                a += df[i] * other[i]
                b += other[i] * f[i]
            part[chunk, j] = a
            part[chunk, kept + j] = b
    return part


@kernel
def _mix(g, dG, theta, out):
    """out = g - dGᵀ θ."""
    n = g.size
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        low, high = chunk * CHUNK, min(n, (chunk + 1) * CHUNK)
        mixed, image = out[low:high], g[low:high]
        for i in range(high - low):
            mixed[i] = image[i]
        for j in range(theta.size):
            t, dg = theta[j], dG[j, low:high]
            for i in range(high - low):
                mixed[i] -= t * dg[i]
