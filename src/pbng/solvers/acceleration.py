"""Accelerations of a fixed-point iteration x <- G(x), for PBNG one sweep (section 7.3 and docs/method.md).

Each is a frozen description; ``start`` makes the state of one solve. Only free vertices are touched: the arrays given
are the leading, free part of a flat position array.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import numpy as np
from numba import uint64

from pbng.errors import InputError
from pbng.jit import serial
from pbng.parallel import array, body, each

CHUNK = 4096  # entries a thread takes at a time; sums are formed chunk by chunk, so that their rounding is fixed


class FixedPoint(Protocol):
    """What is accelerated; arrays are flat positions, of which the first ``n_free`` entries are free."""

    n_free: int
    known_energy: float  # of the state at the start [J], infinite if nobody has asked
    trust: int  # checks that an acceleration has passed in a row, in this solve and those before

    def apply(self, x: np.ndarray, omega: float = 1.0) -> None:
        """x <- G(x), each node's step relaxed by omega."""

    def energy(self, x: np.ndarray) -> float:
        """Potential energy [J] in float64."""

    def admit(self, x: np.ndarray, g: np.ndarray) -> None:
        """Move x out of colliders, and onto them where g touches them: only sweeps let go of what touches."""

    def rises(self, energy: float, before: float, x: np.ndarray) -> bool:
        """Whether an energy is above an earlier one, that of x, by more than rounding may explain."""


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
        g = x.copy()
        self.l += 1
        omega, gamma = real(self.omega(self.l)), real(self.gamma)
        x[:n] = omega * (gamma * (x[:n] - here) + here - before) + before
        self.map.admit(x, g)
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
        self.map, self.softness = map, Softness(omega)
        self.energy = math.inf  # at the last checked state
        self.unchecked = 0  # steps since
        self.history = MixingHistory(memory)
        self.buffers: tuple[np.ndarray, ...] = ()

    def step(self, x: np.ndarray) -> None:
        n = self.map.n_free
        if not self.buffers:
            self.energy = self.map.known_energy
            self.buffers = np.empty_like(x), x.copy(), x.copy()  # G(x), mixed, last checked
        g, mixed, checked = self.buffers
        g[:] = x
        self.map.apply(g, self.softness.omega)
        if self.history.push(x[:n], g[:n]):
            if self.history.mix(g[:n], mixed[:n]):
                self.map.admit(mixed, g)
                if self._trusted():
                    x[:] = mixed
                    self.unchecked += 1
                    return
                if self._passes(mixed):
                    x[:] = mixed
                    return
            if self.unchecked:
                g[:] = checked
                self.map.apply(g, self.softness.omega)
            self._restart()
        elif self._trusted() and math.isfinite(self.energy):
            x[:] = g
            self.unchecked += 1
            return
        energy = self.map.energy(g)
        if self.map.rises(energy, self.energy, checked):
            self.softness.fail()
            self._restart()
            x[:] = checked
            return
        x[:] = checked[:] = g
        self.energy, self.unchecked = energy, 0
        if self.softness.succeed():
            self.history.restart()  # it was that of another map

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
        self.energy, self.unchecked = energy, 0
        self.map.trust += 1
        if self.softness.succeed():
            self.history.restart()  # it was that of another map
        return True

    def _trusted(self) -> bool:
        """Whether the next step need not be checked."""
        return self.map.trust >= self.PROBATION and self.unchecked + 1 < self.EVERY

    def _restart(self) -> None:
        self.history.restart()
        self.map.trust, self.unchecked = 0, 0


class Softness:
    """The relaxation of sweeps: less where they have raised the energy, as of materials whose block does not bound it.

    To halve ω is as good as to double the block. It comes back step by step, ever later after each failure.
    """

    def __init__(self, omega: float) -> None:
        self.omega = self.most = omega
        self.wait, self.patience = 0, 4

    def fail(self) -> None:
        """Sweeps with ω have raised the energy."""
        self.omega = max(0.5 * self.omega, self.most / 4096)
        self.patience = min(2 * self.patience, 256)
        self.wait = self.patience

    def succeed(self) -> bool:
        """They have not; whether ω is now another."""
        if self.omega == self.most:
            return False
        self.wait -= 1
        if self.wait > 0:
            return False
        self.omega, self.wait = min(2 * self.omega, self.most), self.patience
        if self.omega == self.most:
            self.patience = 4
        return True


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
        part, sizes = np.empty((-(-len(x) // CHUNK), 2 * kept)), np.array([len(x), row, kept])
        each(_difference(x.dtype), (x, g, self.f, self.g, self.dF, self.dG, part, sizes), len(part))
        sums = part.sum(0)
        if first:
            return False
        self.gram[row, :kept] = self.gram[:kept, row] = sums[:kept]
        self.rhs[:kept] = sums[kept : 2 * kept]
        return True

    def mix(self, g: np.ndarray, out: np.ndarray) -> bool:
        """Write G(x) - ΔG θ to out, with θ the minimiser of |f - ΔF θ|; False if there is none."""
        theta = self._weights()
        if theta is not None:
            arrays = g, self.dG, out, theta, np.array([len(g), len(theta)])
            each(_mix(g.dtype), arrays, -(-len(g) // CHUNK))
        return theta is not None

    def _weights(self) -> np.ndarray | None:
        """θ of the least-squares problem, from its scaled normal equations with a tiny ridge; None if it has none."""
        theta = np.empty(min(self.count, self.memory))
        return theta if _least_squares(self.gram, self.rhs, theta) else None


@serial
def _least_squares(gram, rhs, theta):
    """Body of :meth:`MixingHistory._weights`: A = L D Lᵀ with no pivot below the ridge, which bounds them all."""
    n = theta.size
    for i in range(n):
        for j in range(n):
            if not (math.isfinite(gram[i, j]) and math.isfinite(rhs[i])):
                return False
    norms = np.sqrt(np.diag(gram)[:n])
    largest, ridge = norms.max(), 1e-12 * n
    if not largest > 0:
        return False
    # A difference lost in rounding has no direction.
    scale = np.array([1 / norm if norm > 1e-12 * largest else 0.0 for norm in norms])
    A, D = np.empty((n, n)), np.empty(n)
    for i in range(n):
        theta[i] = scale[i] * rhs[i]
        for j in range(i + 1):
            A[i, j] = gram[i, j] * scale[i] * scale[j]
            for k in range(j):
                A[i, j] -= A[i, k] * A[j, k] * D[k]
            if j < i:
                A[i, j] /= D[j]
                theta[i] -= A[i, j] * theta[j]
        D[i] = max(A[i, i] + ridge, ridge)
    for i in range(n - 1, -1, -1):
        theta[i] /= D[i]
        for j in range(i + 1, n):
            theta[i] -= A[j, i] * theta[j]
    for i in range(n):
        theta[i] *= scale[i]
    return True


@cache
def _difference(dtype: np.dtype) -> Any:
    """Body that stores the newest differences of chunks low .. high, and of each ΔF_row · ΔF_j, then ΔF_j · f."""
    real = dtype.type

    @body
    def difference(arguments, low, high):
        x, g, f = array(arguments, 0, real), array(arguments, 1, real), array(arguments, 2, real)
        before, dF, dG = array(arguments, 3, real), array(arguments, 4, real), array(arguments, 5, real)
        out, sizes = array(arguments, 6, np.float64), array(arguments, 7, np.int64)
        n, row, kept = sizes[0], uint64(sizes[1]), sizes[2]
        for chunk in range(low, high):
            first, m = uint64(chunk * CHUNK), min(n - chunk * CHUNK, CHUNK)
            to = row * uint64(n) + first
            for i_ in range(m):
                i = uint64(i_)
                step = g[first + i] - x[first + i]
                dF[to + i] = step - f[first + i]  # means nothing on the first call: it is overwritten
                f[first + i] = step
            for i_ in range(m):
                i = uint64(i_)
                dG[to + i] = g[first + i] - before[first + i]
                before[first + i] = g[first + i]
            for j in range(kept):
                other = uint64(j) * uint64(n) + first
                a, b = 0.0, 0.0
                for i_ in range(m):
                    i = uint64(i_)
                    a += dF[to + i] * dF[other + i]
                    b += dF[other + i] * f[first + i]
                out[2 * kept * chunk + j] = a
                out[2 * kept * chunk + kept + j] = b

    return difference


@cache
def _mix(dtype: np.dtype) -> Any:
    """Body of out = g - dGᵀ θ for chunks low .. high."""
    real = dtype.type

    @body
    def mix(arguments, low, high):
        g, dG, out = array(arguments, 0, real), array(arguments, 1, real), array(arguments, 2, real)
        theta, sizes = array(arguments, 3, np.float64), array(arguments, 4, np.int64)
        n, kept = sizes[0], sizes[1]
        for chunk in range(low, high):
            first, m = uint64(chunk * CHUNK), min(n - chunk * CHUNK, CHUNK)
            for i_ in range(m):
                i = first + uint64(i_)
                out[i] = g[i]
            for j in range(kept):
                t, other = theta[j], uint64(j) * uint64(n)
                for i_ in range(m):
                    i = first + uint64(i_)
                    out[i] -= t * dG[other + i]

    return mix
