"""PBD and XPBD (section 6): the passes against NumPy, constraint colours, and what the paper shows of them."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import held_box
from models import cof, polar
from oracle import deformation, shape_gradients
from test_sweep import disturbed

import pbng
from pbng.cli_options import solver as named_solver
from pbng.coloring import color_constraints
from pbng.constraints import WeakConstraints
from pbng.drivers import solve
from pbng.projection.elastic import LOST

SOFT = pbng.Corotated(E=1e3, nu=0.3, density=10.0)  # the paper's, section 11.3-11.4


# An oracle in plain NumPy: one constraint after the other, Eqs. (24)-(26) read aloud.


def pair(material, F):
    """C, ∂C/∂F and k of the two constraints of a material at F (3, 3)."""
    J, H, mu, lam = np.linalg.det(F), cof(F), material.mu, material.lam
    if isinstance(material, pbng.Corotated):
        D = F - polar(F)
        C = np.linalg.norm(D)
        return (C, D / C, 2 * mu), (J - 1, H, lam)
    C = np.linalg.norm(F)
    return (C, F / C, mu), (J - 1 - mu / (mu + lam), H, mu + lam)


class Oracle:
    """The state of a time step: positions and multipliers."""

    def __init__(self, method, x):
        self.problem, self.compliant = method.problem, method.solver.compliant
        self.dt, self.color = method.dt, method.elastic.color
        self.w = np.where(self.problem.fixed, 0, 1 / self.problem.mass)
        self.x = np.array(x, float)
        self.multiplier: dict = {}
        self.geometry = [shape_gradients(self.problem.X[g.cells]) for g in self.problem.groups]

    def project(self, name, C, k, vertices, gradients):
        """Project one scalar constraint with gradients (n, 3)."""
        alpha = 1 / (k * self.dt**2) if self.compliant else 0.0
        old = self.multiplier.get(name, 0.0)
        size = (self.w[vertices] * (gradients**2).sum(1)).sum()
        change = (-C - alpha * old) / (size + alpha)
        self.multiplier[name] = old + change
        self.x[vertices] += (self.w[vertices] * change)[:, None] * gradients

    def elastic(self):
        offset = np.cumsum([0] + [len(g.cells) for g in self.problem.groups])
        for n in np.argsort(self.color, kind="stable"):
            group = np.searchsorted(offset, n, side="right") - 1
            g, e = self.problem.groups[group], n - offset[group]
            vertices, (G, V) = g.cells[e], self.geometry[group]
            if self.problem.fixed[vertices].all():
                continue
            for j in range(2):
                F = deformation(self.x[vertices][None], G[e][None])[0]
                C, N, k = pair(g.material, F)[j]
                self.project((n, j), C, k * V[e], vertices, G[e] @ N.T)

    def weak(self, targets):
        rows, at = [], 0
        for w in self.problem.weak:
            for n in range(len(w.vertices)):
                rows.append((w.vertices[n], w.weights[n], w.K[n], targets[at] if w.anchored else np.zeros(3)))
                at += w.anchored
        color = color_constraints([w.vertices for w in self.problem.weak], self.problem.n_vert)
        for name in np.argsort(color, kind="stable"):
            vertices, weights, K, target = rows[name]
            if self.problem.fixed[vertices].all():
                continue
            stiffness, axes = np.linalg.eigh(K)
            for j in np.flatnonzero(stiffness > 1e-9 * np.abs(K).max()):
                C = axes[:, j] @ (weights @ self.x[vertices] - target)
                self.project(("weak", name, j), C, stiffness[j], vertices, np.outer(weights, axes[:, j]))


def run(problem, solver, iterations):
    return solve(problem, solver, pbng.Budget(iterations=iterations, every=iterations)).x


def bound_bodies(material=pbng.NeoHookean, plane=True):
    """A box of two materials and a plane triangle mesh, under gravity, with weak constraints of every sort."""
    box = pbng.shapes.box((1.0, 0.8, 0.6), (4, 3, 3))
    half = np.arange(box.n_elem) % 2
    box = pbng.TetMesh(box.X, box.cells, cell_groups={"a": half == 0, "b": half == 1})
    scene = pbng.Scene(gravity=(0.5, -9.8, 0.0))
    a = scene.add(box, {"a": pbng.Corotated(E=1e5, nu=0.3), "b": material(E=2e5, nu=0.4)})
    scene.pin(a.where(x=0.0))
    if plane:
        b = scene.add(pbng.shapes.rectangle((1.0, 0.7), (4, 3)), pbng.Corotated(E=1e5, nu=0.2), at=(0, 3.0, 0.25))
        scene.pin(b.where(x=0.0))
    problem = scene.compile()
    rng = np.random.default_rng(5)
    free = rng.permutation(np.flatnonzero(~problem.fixed[: box.n_vert])).astype(np.int32)

    def stiffness(m, rank):
        A = rng.standard_normal((m, 3, rank))
        return 1e4 * A @ A.transpose(0, 2, 1)

    pairs, tets, lone = free[:8].reshape(4, 2), free[4:12].reshape(2, 4), free[6:9].reshape(3, 1)
    weights = np.array([[0.3, 0.7, -0.4, -0.6], [1.0, -0.2, -0.3, -0.5]])
    goal = problem.X[lone[:, 0]] + [0.05, -0.1, 0.02]
    weak = (
        WeakConstraints(pairs, np.tile([1.0, -1.0], (4, 1)), stiffness(4, 1)),
        WeakConstraints(tets, weights, stiffness(2, 3)),
        WeakConstraints(lone, np.ones((3, 1)), np.stack([1e6 * np.eye(3)] * 3), lambda t: goal),
    )
    return replace(problem, weak=weak)


@pytest.mark.parametrize("order", ["elastic first", "weak first"])
def test_passes_equal_the_oracle(rng, order):
    """Eqs. (24)-(26) on tets, plane triangles and weak constraints, three iterations: positions and multipliers."""
    problem = bound_bodies()
    method = pbng.XPBD(dt=0.01, iterations=None, order=order, dtype="float64").set_up(problem)
    x = disturbed(problem, 0.05, rng)
    method.start(x)
    oracle = Oracle(method, x)
    oracle.x += (method.dt**2 * oracle.w)[:, None] * problem.f_ext
    targets = problem.targets(0.0)
    for _ in range(3):
        method.step()
        for part in "ew" if order == "elastic first" else "we":
            oracle.elastic() if part == "e" else oracle.weak(targets)
        np.testing.assert_allclose(method.state(), oracle.x, rtol=0, atol=1e-12)
    assert np.abs(oracle.x - x).max() > 0.01
    assert any(oracle.multiplier.values())


@pytest.mark.parametrize("vertices", [(7, 6, 6), (5, 5, 5)])
def test_lanes_that_are_left_over(vertices, rng):
    """Colours of more than one block, the last of them not full: no constraint is projected twice."""
    problem = held_box(pbng.Corotated(E=1e5, nu=0.3), vertices)
    method = pbng.XPBD(dt=0.01, iterations=None, dtype="float64").set_up(problem)
    assert np.bincount(method.elastic.color).max() > (16 if vertices[0] == 7 else 8)
    x = disturbed(problem, 0.02, rng)
    method.start(x)
    oracle = Oracle(method, x)
    for _ in range(2):
        method.step()
        oracle.elastic()
        np.testing.assert_allclose(method.state(), oracle.x, rtol=0, atol=1e-12)


def test_pbd_equals_the_oracle(rng):
    """Without compliance, constraints of zero stiffness left out."""
    problem = bound_bodies(pbng.Corotated)
    method = pbng.PBD(dt=0.01, dtype="float64").set_up(problem)
    x = disturbed(problem, 0.01, rng)
    method.start(x)
    oracle = Oracle(method, x)
    oracle.x += (method.dt**2 * oracle.w)[:, None] * problem.f_ext
    for _ in range(2):
        method.step()
        oracle.elastic()
        oracle.weak(problem.targets(0.0))
        np.testing.assert_allclose(method.state(), oracle.x, rtol=0, atol=1e-12)


def test_float32_is_close(rng):
    problem = bound_bodies(plane=False)
    x, states = disturbed(problem, 0.05, rng), []
    for dtype in ("float32", "float64"):
        method = pbng.XPBD(dt=0.01, iterations=2, dtype=dtype).set_up(problem)
        method.start(x)
        for _ in range(3):
            method.step()
        states.append(method.state())
    assert states[0].dtype == np.float32
    assert 0 < np.abs(states[0] - states[1]).max() < 1e-5


@pytest.mark.parametrize("material", [pbng.Corotated, pbng.NeoHookean])
def test_constraints_are_the_energy(material, rng):
    """Eq. (21): Σ V k/2 C² differs from the energy by a constant, inverted elements included."""
    problem = held_box(material(E=1e5, nu=0.3))
    (group,) = problem.groups
    G, V = shape_gradients(problem.X[group.cells])

    def squares(x):
        F = deformation(x[group.cells], G)
        return sum(v * k / 2 * C**2 for f, v in zip(F, V) for C, _, k in pair(group.material, f))

    for amount in (0.05, 0.3):
        x = disturbed(problem, amount, rng)
        assert squares(x) - squares(problem.X + 1e-13 * x) == pytest.approx(problem.energy(x), rel=1e-9)
        form = group.material.constraints()
        assert form.stiffness == tuple(k for *_, k in pair(group.material, np.eye(3) * 1.1))


@pytest.mark.parametrize("amount", [1e-2, 1e-3])
def test_one_projection_meets_its_constraint(amount, rng):
    """PBD on one tet with ν = 0, which leaves |F - R|: what remains after one iteration is of second order."""
    scene = pbng.Scene()
    tet = pbng.TetMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]), [[0, 1, 2, 3]])
    body = scene.add(tet, pbng.Corotated(E=1e5, nu=0.0))
    scene.pin(body.where(np.array([0])))
    problem = scene.compile()
    method = pbng.PBD(dtype="float64").set_up(problem)
    x = disturbed(problem, amount, rng)
    G, _ = shape_gradients(problem.X[[[0, 1, 2, 3]]])
    strain = []
    for _ in range(2):
        strain.append(pair(problem.groups[0].material, deformation(x[None], G)[0])[0][0])
        method.start(x)
        method.step()
        x = method.state()
    assert strain[0] > amount / 2
    assert strain[1] < 5 * strain[0] ** 2


# Colours.


def disjoint(stencils, color):
    """Whether no vertex is in two constraints of one colour."""
    vertices = np.concatenate([s.ravel() for s in stencils])
    colors = np.repeat(color, np.concatenate([np.full(len(s), s.shape[1]) for s in stencils]))
    return len(np.unique(np.stack([vertices, colors]), axis=1).T) == len(vertices)


def test_greedy_colours_are_the_smallest_left():
    """Section 10, by hand, with stencils of two sizes."""
    stencils = [np.array([[0, 1, 2], [2, 3, 4], [3, 5, 6]], np.int32), np.array([[5, 6], [0, 4], [7, 8]], np.int32)]
    assert color_constraints(stencils, 9).tolist() == [0, 1, 0, 1, 2, 0]
    assert color_constraints([], 3).tolist() == []


def test_more_than_128_colours(rng):
    """Two words a vertex are used up, and a new set of colours begins: 300 springs at one vertex."""
    star = np.column_stack([np.zeros(300, np.int32), np.arange(1, 301, dtype=np.int32)])
    others = rng.permuted(np.tile(np.arange(301, dtype=np.int32), (200, 1)), axis=1)[:, :3].copy()
    color = color_constraints([star, others], 301)
    assert color[:300].tolist() == list(range(300))
    assert disjoint([star, others], color)


# What the paper shows.


THREADS = """
import hashlib, sys
import numpy as np, pbng
sys.path.insert(0, sys.argv[1])
from test_xpbd_claims import bound_bodies, two_blocks
from conftest import twisted_bar

digests = set()
for threads in (1, 2, None):
    digest = hashlib.sha256()
    for problem in (bound_bodies(), two_blocks()[0], twisted_bar(vertices=(14, 9, 9)).compile()):
        result = pbng.solve(problem, pbng.XPBD(threads=threads), pbng.Budget(iterations=40))
        for part in (result.x, result.residuals, result.energies):
            digest.update(part.tobytes())
    digests.add(digest.hexdigest())
print(*digests)
"""


def test_same_bits_for_one_and_two_threads():
    here = str(Path(__file__).parent)
    path = os.pathsep.join([str(Path(pbng.__file__).parents[1]), here])
    env = {**os.environ, "NUMBA_NUM_THREADS": "2", "PYTHONPATH": path}
    out = subprocess.run([sys.executable, "-c", THREADS, here], env=env, check=True, capture_output=True, text=True)
    assert len(out.stdout.split()) == 1


@pytest.mark.parametrize("solver", [pbng.XPBD(), pbng.PBD()])
@pytest.mark.parametrize("where", ["line", "point", "mirrored"])
def test_collapsed_starts_stay_finite(solver, where):
    """Lost gradients and constraints without a direction make no NaN."""
    problem = held_box(pbng.Corotated(E=1e5, nu=0.3))
    x = {"line": problem.X * [1, 0, 0], "point": problem.X * 0, "mirrored": problem.X * [-1, 1, 1]}[where]
    x = np.where(problem.fixed[:, None], problem.X, x)
    method = solver.set_up(problem)
    method.start(x)
    for _ in range(20):
        method.step()
    assert np.isfinite(method.state()).all()
    assert 0 < LOST < 1e-3


def test_rest_stays_put():
    """At rest without load nothing moves, not even where |F - R| has no direction."""
    problem = held_box(pbng.Corotated(E=1e5, nu=0.3))
    for solver in (pbng.XPBD(dtype="float64"), pbng.PBD(dtype="float64")):
        np.testing.assert_allclose(run(problem, solver, 20), problem.X, atol=1e-14)


def test_plane_triangles_stay_in_their_plane(rng):
    """z never moves, to the last bit."""
    problem = bound_bodies()
    problem = replace(problem, weak=())
    mine = np.unique(problem.groups[-1].cells)
    method = pbng.XPBD(dtype="float64").set_up(problem)
    method.start(disturbed(problem, 0.05, rng))
    for _ in range(20):
        method.step()
    np.testing.assert_array_equal(method.state()[mine, 2], 0.25)
    assert np.abs(method.state()[mine] - problem.X[mine]).max() > 0


def test_far_from_the_origin():
    """Float32 positions are kept relative to the scene."""
    states = []
    for at in ((0, 0, 0), (4096.0, 0, 0)):
        scene = pbng.Scene(gravity=(0, -9.8, 0))
        body = scene.add(pbng.shapes.box((1.0, 0.5, 0.5), (5, 3, 3)), SOFT, at=at)
        scene.pin(body.where(x=at[0]))
        states.append(run(scene.compile(), pbng.XPBD(), 50) - at)
    assert np.abs(states[1] - states[0]).max() < 1e-4


def test_nothing_free():
    """A problem whose vertices are all prescribed is solved from the start, and a step changes nothing."""
    scene = pbng.Scene()
    body = scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 2), SOFT)
    scene.pin(body.where(np.arange(8)))
    for problem in (scene.compile(), scene.compile().dynamic(0.1)):
        result = solve(problem, pbng.XPBD(), pbng.Budget(iterations=5))
        assert result.status is pbng.Status.CONVERGED
        method = pbng.XPBD().set_up(problem)
        method.start(problem.X)
        method.step()
        np.testing.assert_allclose(method.state(), problem.X)


def test_bad_arguments_are_named():
    for words, message in (
        ({"dt": 0.0}, "XPBD: dt must be positive and finite, not 0.0"),
        ({"dt": float("nan")}, "dt must be positive"),
        ({"iterations": 0}, "XPBD: iterations must be a whole number of at least 1, or None, not 0"),
        ({"iterations": 1.5}, "whole number"),
        ({"order": "both"}, "XPBD: order must be 'elastic first' or 'weak first', not 'both'"),
        ({"damping": 2.0}, "XPBD: damping must be 'kinetic' or lie between 0 and 1, not 2.0"),
        ({"damping": "much"}, "not 'much'"),
        ({"dtype": "auto"}, "XPBD: dtype must be 'float32' or 'float64', not 'auto'"),
        ({"threads": 0}, "XPBD: threads must lie"),
    ):
        with pytest.raises(pbng.InputError, match=message):
            pbng.XPBD(**words)
    with pytest.raises(pbng.InputError, match="PBD: dt must"):
        pbng.PBD(dt=-1.0)


@pytest.mark.parametrize(
    ("solver", "material", "message"),
    [
        (pbng.XPBD(), pbng.StableNeoHookean(E=1.0, nu=0.3), "XPBD: StableNeoHookean has no form .* Corotated and Neo"),
        (pbng.PBD(), pbng.LinearElastic(E=1.0, nu=0.3), "PBD: LinearElastic has no form"),
        (pbng.XPBD(), pbng.Corotated(E=1.0, nu=-0.2), "Corotated with nu=-0.2 has a constraint of negative stiffness"),
        (pbng.PBD(), pbng.NeoHookean(E=1.0, nu=0.3), "PBD: the constraints of NeoHookean cannot be met at rest"),
        (pbng.XPBD(), pbng.Corotated(E=1.0, nu=0.3, density=0.0), "XPBD: vertex .* has no mass"),
    ],
)
def test_problems_without_constraints_are_named(solver, material, message):
    with pytest.raises(pbng.InputError, match=message):
        solver.set_up(held_box(material))


def test_by_name():
    """The command line knows them, with precision and threads."""
    budget = pbng.Budget(iterations=5)
    assert named_solver(None, budget, "xpbd", None, None) == pbng.XPBD()
    assert named_solver(None, budget, "PBD", "float64", 1) == pbng.PBD(dtype="float64", threads=1)
