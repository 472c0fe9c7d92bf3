"""Does a material keep the promises the kernels rely on? ``check_material`` measures each of them."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numba import njit
from numba.core.errors import NumbaError

from pbng.dispatch import call, specialised
from pbng.errors import InputError
from pbng.jit import FLAGS, inline
from pbng.materials.base import Material, Model, has_hessian, model_of
from pbng.materials.differentials import differential

N_STATE = 500  # deformation gradients of each sort
N_NODE = 2000  # configurations of one node
STEPS = 8  # displacements tried from each


@dataclass(frozen=True)
class Axiom:
    """One promise: it holds if ``value`` is at most ``bound``; ``value`` is None where it is not claimed."""

    name: str
    value: float | None
    bound: float
    note: str = ""

    @property
    def ok(self) -> bool:
        """Whether it holds, or is not claimed."""
        return self.value is None or bool(self.value <= self.bound)  # a NaN does not hold


@dataclass(frozen=True)
class Report:
    """What :func:`check_material` found; print it."""

    material: str
    axioms: tuple[Axiom, ...]

    @property
    def ok(self) -> bool:
        """Whether every axiom holds."""
        return all(a.ok for a in self.axioms)

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the axioms that do not hold."""
        return tuple(a.name for a in self.axioms if not a.ok)

    def __getitem__(self, name: str) -> Axiom:
        for axiom in self.axioms:
            if axiom.name == name:
                return axiom
        raise KeyError(f"no axiom {name!r}; there are {', '.join(a.name for a in self.axioms)}")

    def __str__(self) -> str:
        rows = []
        for a in self.axioms:
            value = "-" if a.value is None else f"{a.value:.3g}" if a.bound else f"{a.value:.0f}"
            verdict = "not claimed" if a.value is None else "ok" if a.ok else "FAILS"
            rows.append((a.name, value, f"{a.bound:g}", verdict, a.note))
        width = [max(len(r[k]) for r in rows) for k in range(4)]
        held = sum(a.ok for a in self.axioms)
        lines = [f"{self.material}: {held} of {len(rows)} axioms hold"]
        for name, value, bound, verdict, note in rows:
            line = f"  {name:<{width[0]}}  {value:>{width[1]}} <= {bound:<{width[2]}}  {verdict:<{width[3]}}  {note}"
            lines.append(line.rstrip())
        return "\n".join(lines)


def check_material(material: Material) -> Report:
    """Measure whether a material keeps its promises; the same numbers on every run.

    Stresses and energies are measured against the block's a [Pa], lengths of the deformation gradient being of order
    one, so the bounds are pure numbers. States are random with regular, near-singular and inverted F; for the block
    also flattened to a plane, a line or a point. The axioms:

    ``finite``: values of Ψ and P that are NaN or infinite, inverted and collapsed states included. ``rest energy``,
    ``rest stress``: zero at F = I. ``stress, ...``: P against differences of Ψ. ``objectivity``: Ψ(QF) = Ψ(F) for
    rotations Q. ``isotropy``: Ψ(FQ) = Ψ(F), claimed by ``isotropic``. ``rest Hessian``: that of linear elasticity with
    the material's μ and λ, Frobenius norm. ``Hessian, ...``: ``hessian`` against differences of P, where the material
    has one of its own. ``float32``: the stress in float32 against float64, relative to what a
    relative change of F by one would make of it. ``block``: number of 2,000 configurations of one node in which the
    energy somewhere exceeds its majoriser E + Pg·u + ½ uᵀAu (method.md), for random displacements u and along the
    Newton step; if it is not 0 updates may raise the energy, and the note says from which largest stretch on.

    Raises:
        InputError: It is not a material, or its functions do not compile.
    """
    if not isinstance(material, Material):
        raise InputError(f"check_material: expected a material such as Corotated(E=1e5, nu=0.3), not {material!r}")
    if material.surface:
        raise InputError(f"check_material: {type(material).__name__} is a material of surfaces; it checks solids only")
    return _Check(material).report()


class _Check:
    def __init__(self, material: Material) -> None:
        self.material = material
        self.scale = material.block().a
        self.rng = np.random.default_rng(0)
        rng = self.rng
        ordinary = rng.uniform(0.5, 2.0, (N_STATE, 3))
        flat = np.column_stack([ordinary[:, :2], rng.choice([-1, 1], N_STATE) * 10 ** rng.uniform(-6, -2, N_STATE)])
        inverted = np.column_stack([rng.uniform(0.8, 2.0, (N_STATE, 2)), rng.uniform(-0.6, -0.1, N_STATE)])
        self.states = {
            "regular": self._turned(ordinary),
            "near-singular": self._turned(flat),
            "inverted": self._turned(inverted),
        }

    def report(self) -> Report:
        every = np.concatenate(list(self.states.values()))
        axioms = [
            self._finite(np.concatenate([every, self._collapsed(N_STATE)])),
            *self._rest(),
            *(self._stress(name, F) for name, F in self.states.items()),
            self._invariance("objectivity", every, left=True),
            self._invariance("isotropy", every, left=False),
            self._rest_hessian(),
            *(self._hessian(name, F) for name, F in self.states.items() if has_hessian(type(self.material))),
            self._float32(np.concatenate([self.states["regular"], self.states["near-singular"]])),
            self._block(),
        ]
        return Report(repr(self.material), tuple(axioms))

    def psi(self, F: np.ndarray) -> np.ndarray:
        return self._evaluate(F)[0]

    def stress(self, F: np.ndarray) -> np.ndarray:
        return self._evaluate(F)[1]

    def _evaluate(self, F: np.ndarray, dtype: type = np.float64) -> tuple[np.ndarray, np.ndarray]:
        """Ψ (n,) and P (n, 3, 3) at F (n, 3, 3)."""
        numbers = tuple(dtype(p) for p in self.material.parameters())
        cls: Any = type(self.material)
        model = model_of(cls, len(numbers))
        psi: np.ndarray = np.empty(len(F), dtype)
        P: np.ndarray = np.empty((len(F), 3, 3), dtype)
        try:
            _evaluator(model)(np.ascontiguousarray(F, dtype), numbers, psi, P)
        except NumbaError as error:
            raise InputError(f"{model.name}: energy or stress does not compile:\n{error}") from error
        return psi, P

    def _turned(self, sigma: np.ndarray) -> np.ndarray:
        """F (n, 3, 3) with the given signed singular values and random axes."""
        n = len(sigma)
        return self._rotations(n) * sigma[:, None, :] @ self._rotations(n)

    def _rotations(self, n: int) -> np.ndarray:
        Q, R = np.linalg.qr(self.rng.standard_normal((n, 3, 3)))
        Q *= np.sign(np.einsum("nii->ni", R))[:, None, :]
        return Q * np.sign(np.linalg.det(Q))[:, None, None]

    def _collapsed(self, n: int) -> np.ndarray:
        """F of rank 2, 1 and 0."""
        sigma = self.rng.uniform(0.2, 2.0, (n, 3))
        sigma[:, 2] = 0
        sigma[n // 2 :, 1] = 0
        sigma[-n // 10 :] = 0
        return self._turned(sigma)

    def _directions(self, n: int) -> np.ndarray:
        D = self.rng.standard_normal((n, 3, 3))
        return D / np.linalg.norm(D, axis=(1, 2), keepdims=True)

    def _finite(self, F: np.ndarray) -> Axiom:
        bad = sum(
            np.count_nonzero(~(np.isfinite(psi) & np.isfinite(P).all((1, 2))))
            for psi, P in (self._evaluate(F), self._evaluate(F, np.float32))
        )
        return Axiom("finite", float(bad), 0, f"of {2 * len(F)} values of energy and stress")

    def _rest(self) -> list[Axiom]:
        psi, P = self._evaluate(np.eye(3)[None])
        return [
            Axiom("rest energy", float(abs(psi[0])) / self.scale, 1e-12),
            Axiom("rest stress", float(np.linalg.norm(P[0])) / self.scale, 1e-12),
        ]

    def _stress(self, name: str, F: np.ndarray) -> Axiom:
        """P : D against differences of fourth order."""
        P = self.stress(F)
        size = np.linalg.norm(P, axis=(1, 2)) + self.scale
        worst = np.zeros(len(F))
        for _ in range(3):
            D = self._directions(len(F))
            worst = np.maximum(worst, np.abs(_difference(self.psi, F, D, 5e-4) - (P * D).sum((1, 2))) / size)
        return Axiom(f"stress, {name}", float(worst.max()), 1e-7)

    def _invariance(self, name: str, F: np.ndarray, left: bool) -> Axiom:
        if not (left or self.material.isotropic):
            return Axiom(name, None, 1e-11)
        Q = self._rotations(len(F))
        psi = self.psi(F)
        change = self.psi(Q @ F if left else F @ Q) - psi
        return Axiom(name, float((np.abs(change) / (np.abs(psi) + self.scale)).max()), 1e-11)

    def _rest_hessian(self) -> Axiom:
        one, mu, lam = np.eye(3), self.material.mu, self.material.lam
        D = np.eye(9).reshape(9, 3, 3)
        got = _difference(self.stress, np.broadcast_to(one, (9, 3, 3)), D, 1e-4)
        want = mu * (D + D.transpose(0, 2, 1)) + lam * np.einsum("nii->n", D)[:, None, None] * one
        return Axiom("rest Hessian", float(np.linalg.norm(got - want) / np.linalg.norm(want)), 1e-7)

    def _hessian(self, name: str, F: np.ndarray) -> Axiom:
        """∂P/∂F : D, for all D, against differences of fourth order."""
        cls: Any = type(self.material)
        model = model_of(cls, len(self.material.parameters()))
        try:
            got = derivatives(model, F, self.material.parameters())
        except NumbaError as error:
            raise InputError(f"{model.name}: hessian does not compile:\n{error}") from error
        size = np.linalg.norm(got, axis=(1, 2)) + self.scale
        worst = np.zeros(len(F))
        for k, D in enumerate(np.eye(9).reshape(9, 3, 3)):
            want = _difference(self.stress, F, D, 5e-4).reshape(-1, 9)
            worst = np.maximum(worst, np.abs(got[:, :, k] - want).max(1) / size)
        return Axiom(f"Hessian, {name}", float(worst.max()), 1e-6)

    def _float32(self, F: np.ndarray) -> Axiom:
        F = F.astype(np.float32).astype(np.float64)
        exact, rounded = self.stress(F), self._evaluate(F, np.float32)[1]
        size = np.linalg.norm(F, axis=(1, 2))
        slope = np.zeros(len(F))
        for _ in range(3):
            change = _difference(self.stress, F, self._directions(len(F)), 1e-6)
            slope = np.maximum(slope, np.linalg.norm(change, axis=(1, 2)))
        change = np.linalg.norm(rounded - exact, axis=(1, 2))
        allowed = np.linalg.norm(exact, axis=(1, 2)) + size * slope + self.scale
        return Axiom("float32", float((change / allowed).max()), 1e-5)

    def _block(self) -> Axiom:
        """One node of one element: F(u) = F + u gᵀ, V = 1; a sum of majorised energies is majorised."""
        rng, block = self.rng, self.material.block()
        wild = rng.standard_normal((N_NODE // 4, 3, 3))
        every = [*self.states.values(), self._collapsed(N_NODE), wild]
        F = np.concatenate(every)[rng.permutation(sum(map(len, every)))[:N_NODE]]
        g = rng.standard_normal((N_NODE, 3))
        psi, P = self._evaluate(F)
        c = g if block.at_rest else np.einsum("nij,nj->ni", _cofactor(F), g)
        f = -np.einsum("nij,nj->ni", P, g)
        A = block.a * (g * g).sum(1)[:, None, None] * np.eye(3) + block.b * c[:, :, None] * c[:, None, :]
        newton = np.linalg.solve(A, f[:, :, None])[:, :, 0]
        length = np.linalg.norm(g, axis=1)[:, None]
        violated, reach = np.zeros(N_NODE, bool), np.full(N_NODE, np.inf)
        for k in range(STEPS):
            u = 10 ** rng.uniform(-2, 1, (N_NODE, 1)) * rng.standard_normal((N_NODE, 3)) / length
            if k % 2 == 0:
                u = rng.uniform(0, 2, (N_NODE, 1)) * newton + (1e-2 * u if k % 4 else 0)
            u = np.where(np.isfinite(u), u, 0)
            G = F + u[:, :, None] * g[:, None, :]
            slope, curve = (f * u).sum(1), np.einsum("ni,nij,nj->n", u, A, u) / 2
            there = self.psi(G)
            tolerance = 1e-6 * (np.abs(psi) + np.abs(there) + np.abs(slope) + curve + self.scale)
            above = ~(there <= psi - slope + curve + tolerance)
            violated |= above
            far = np.maximum(np.linalg.norm(F, 2, (1, 2)), np.linalg.norm(G, 2, (1, 2)))
            reach = np.where(above, np.minimum(reach, far), reach)
        count = int(np.count_nonzero(violated))
        note = f"of {N_NODE} nodes" + (f"; from a largest stretch of {reach.min():.2f} on" if count else "")
        return Axiom("block", float(count), 0, note)


def _difference(value: Any, F: np.ndarray, D: np.ndarray, h: float) -> np.ndarray:
    """Derivative of ``value(F)`` along D, of fourth order in h."""
    return (8 * (value(F + h * D) - value(F - h * D)) - (value(F + 2 * h * D) - value(F - 2 * h * D))) / (12 * h)


def _cofactor(F: np.ndarray) -> np.ndarray:
    a, b, c = F[:, :, 0], F[:, :, 1], F[:, :, 2]
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=2)


def derivatives(model: Model, F: np.ndarray, numbers: tuple[float, ...]) -> np.ndarray:
    """∂P/∂F [Pa] (n, 9, 9) of a model at F (n, 3, 3), rows and columns in order of F_ik: its own, or by differences."""
    out = np.empty((len(F), 9, 9))
    kernel = specialised(make_derivatives, (differential(model),))
    kernel(np.ascontiguousarray(F, float), np.eye(9), tuple(float(p) for p in numbers), out)
    return out


def make_derivatives(key: str) -> Any:
    """Kernel that fills ∂P/∂F (n, 9, 9) at F (n, 3, 3)."""

    @njit(cache=True, **FLAGS)
    def evaluate(F, unit, numbers, out):
        for n in range(len(F)):
            f = (
                (F[n, 0, 0], F[n, 1, 0], F[n, 2, 0]),
                (F[n, 0, 1], F[n, 1, 1], F[n, 2, 1]),
                (F[n, 0, 2], F[n, 1, 2], F[n, 2, 2]),
            )
            for d in range(9):
                e = unit[d]
                P = call(key, 0, (f, ((e[0], e[3], e[6]), (e[1], e[4], e[7]), (e[2], e[5], e[8])), *numbers))
                for i in range(3):
                    for k in range(3):
                        out[n, 3 * i + k, d] = P[k][i]

    return evaluate


@cache
def _evaluator(model: Model) -> Any:
    """The kernel that evaluates a model at many F."""
    energy, stress = model.energy, model.stress

    @inline
    def both(F, *numbers):
        return energy(F, *numbers), stress(F, *numbers)

    return specialised(make_evaluate, (both,))


def make_evaluate(key: str) -> Any:
    """Kernel that fills Ψ (n,) and P (n, 3, 3) at F (n, 3, 3)."""

    @njit(cache=True, **FLAGS)
    def evaluate(F, numbers, psi, P):
        for n in range(len(F)):
            f = (
                (F[n, 0, 0], F[n, 1, 0], F[n, 2, 0]),
                (F[n, 0, 1], F[n, 1, 1], F[n, 2, 1]),
                (F[n, 0, 2], F[n, 1, 2], F[n, 2, 2]),
            )
            psi[n], columns = call(key, 0, (f, *numbers))
            for i in range(3):
                P[n, i, 0] = columns[0][i]
                P[n, i, 1] = columns[1][i]
                P[n, i, 2] = columns[2][i]

    return evaluate
