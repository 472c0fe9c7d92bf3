"""Membranes and hinges: derivatives, invariance, blocks, the sweep against the oracle, degenerate states."""

import math

import numpy as np
import oracle
import pytest
from conftest import hard_start
from numba import njit
from test_energy_decay import energies, rise
from test_sweep import against_oracle

import pbng
from pbng.compounds import Compounds
from pbng.linalg import arctan2
from pbng.packing import pack_problem
from pbng.sweep import sweep

CLOTH = pbng.Membrane(E=1e3, nu=0.3, density=0.3)
BENDINGS = [pbng.Bending(k=0.05, rest=rest, weighted=w) for rest in ("flat", "mesh") for w in (False, True)]


def bumpy(vertices=(6, 5), size=(1.0, 0.8), seed=5):
    """A sheet that is not flat at rest."""
    mesh = pbng.shapes.sheet(size, vertices)
    return pbng.TriMesh(mesh.X + np.random.default_rng(seed).normal(0, 0.03, mesh.X.shape), mesh.cells)


def hung(bending=None, mesh=None, material=CLOTH, gravity=(0.0, -9.8, 0.0)):
    """A sheet held at two corners."""
    mesh = mesh or bumpy()
    scene = pbng.Scene(gravity=gravity)
    body = scene.add(mesh, material, bending)
    scene.pin(body.where(np.array([0, int(np.argmax(mesh.X[:, 0] - mesh.X[:, 2]))])))
    return scene.compile()


def wardrobe():
    """Sheets with and without hinges, of either weight and rest, a tet body and a plane one, in one problem."""
    scene = pbng.Scene(gravity=(0.3, -9.8, 0.2))
    for k, bending in enumerate((None, BENDINGS[0], BENDINGS[3])):
        body = scene.add(bumpy(seed=k), pbng.Membrane(E=1e3 + k, nu=0.1 * k, density=0.3), bending, at=(0, k, 0))
        scene.pin(body.where(np.arange(2)))
    box = scene.add(pbng.shapes.box((0.5, 0.5, 0.5), 3), pbng.NeoHookean(E=1e3, nu=0.3, density=1.0), at=(3, 0, 0))
    scene.pin(box.where(x=3.0))
    plate = scene.add(pbng.shapes.rectangle((0.5, 0.5), 3), pbng.NeoHookean(E=1e3, nu=0.3, density=1.0), at=(5, 0, 0))
    scene.pin(plate.where(x=5.0))
    return scene.compile()


def crumpled(problem, amount, seed=0):
    """Free vertices moved at random, but those of plane domains in their plane."""
    step = np.random.default_rng(seed).normal(0, amount, problem.X.shape) * ~problem.fixed[:, None]
    for group in problem.groups:
        if group.kind.name == "triangle":
            step[group.cells, 2] = 0
    return problem.X + step


def folded(angle, sign=1.0):
    """Two triangles folded at their common edge, and the angle's sign by which side they are seen from."""
    c, s = math.cos(angle), math.sin(angle)
    X = np.array([[0, 0, 0], [1, 0, 0], [0.4, 0.8, 0], [0.6, -0.7 * c, -0.7 * s * sign]])
    cells = [[0, 1, 2], [1, 0, 3]]
    return pbng.TriMesh(X @ np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0], cells)


# ------------------------------------------------------------------------------------------------------- derivatives


@pytest.mark.parametrize("amount", [0.0, 0.01, 0.1, 0.5])
def test_forces_are_the_gradient_of_the_energy(amount, rng):
    """Of cloth beside solids, at rest, stretched and crumpled."""
    problem = wardrobe()
    x = crumpled(problem, amount)
    total = problem.forces(x) + problem.f_ext
    scale = np.abs(problem.forces(crumpled(problem, 0.1))).max()
    for group in problem.groups:
        step = np.zeros_like(x)
        mine = np.unique(group.cells)
        step[mine] = rng.standard_normal((len(mine), 3))
        if group.kind.name == "triangle":
            step[:, 2] = 0
        found = oracle.energy_gradient(problem.energy, x, step, 1e-5)
        assert found == pytest.approx(-np.sum(total * step), rel=1e-6, abs=1e-6 * scale)


def test_membrane_hessian_is_the_derivative_of_its_stress(rng):
    mu, lam = CLOTH.parameters()
    for _ in range(50):
        F, D = rng.normal(size=(2, 3)), rng.normal(size=(2, 3))
        up, down = (np.array(pbng.Membrane.stress(tuple(map(tuple, F + s * D)), mu, lam)) for s in (1e-6, -1e-6))
        exact = np.array(pbng.Membrane.hessian(tuple(map(tuple, F)), tuple(map(tuple, D)), mu, lam))
        np.testing.assert_allclose(exact, (up - down) / 2e-6, atol=1e-6 * np.abs(exact).max())


def test_membrane_near_rest_has_no_cancellation():
    """|F - R|² of a strain of 1e-7 is known to many digits."""
    F = (1.0 + 1e-7, 0.0, 0.0), (0.0, 1.0, 0.0)
    assert pbng.Membrane.energy(F, 1.0, 0.0) == pytest.approx(1e-14, rel=1e-6)


def test_rigid_motion_changes_nothing(rng):
    """Energy and the norms of forces stay under rotation and translation, also from a crumpled state."""
    for bending in BENDINGS:
        problem = hung(bending, gravity=(0, 0, 0))
        Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        Q *= np.sign(np.linalg.det(Q))
        x = crumpled(problem, 0.1)
        y = x @ Q.T + [1.0, -2.0, 3.0]
        assert problem.energy(y) == pytest.approx(problem.energy(x), rel=1e-10)
        scale = np.abs(problem.forces(x)).max()
        np.testing.assert_allclose(problem.forces(y), problem.forces(x) @ Q.T, atol=1e-9 * scale)
        f = problem.forces(x)
        np.testing.assert_allclose(f.sum(0), 0, atol=1e-10 * scale)
        np.testing.assert_allclose(np.cross(x, f).sum(0), 0, atol=1e-10 * scale)


def test_rest():
    """No energy and no forces at rest, if the angles at rest are the mesh's or the mesh is flat."""
    for bending, mesh in ((BENDINGS[2], bumpy()), (BENDINGS[3], bumpy()), (BENDINGS[1], pbng.shapes.sheet())):
        problem = hung(bending, mesh, gravity=(0, 0, 0))
        assert problem.energy(problem.X) < 1e-20
        np.testing.assert_allclose(problem.forces(problem.X), 0, atol=1e-8)
        assert problem.energy(problem.X @ np.diag([1.0, 1.0, 0.5])) > 0.1
        mirrored = problem.X[:, [0, 2, 1]]  # cloth has no inside: nothing is strained, but folds are on the other side
        assert hung(None, mesh, gravity=(0, 0, 0)).energy(mirrored) < 1e-20
        assert (problem.energy(mirrored) > 1e-3) == (bending.rest == "mesh")
    assert hung(BENDINGS[0], bumpy(), gravity=(0, 0, 0)).energy(bumpy().X) > 1e-4


@pytest.mark.parametrize("degrees", [-170, -90, -30, -1e-3, 0, 1e-3, 30, 90, 170])
def test_angle_of_a_fold(degrees):
    """The energy of a fold is k/2 θ², and with the weight 3 |e|²/A times as much; the sign counts beside θ₀."""
    angle = math.radians(degrees)
    for bending in BENDINGS:
        problem = hung(bending, folded(0.4), gravity=(0, 0, 0))
        weight = 3 / (0.5 * 0.8 + 0.5 * 0.7) if bending.weighted else 1.0
        change = angle - (0.4 if bending.rest == "mesh" else 0.0)
        change = min(change, change + 2 * math.pi, key=abs)  # what is folded further comes back from the other side
        expected = 0.5 * weight * 0.05 * change**2
        assert problem.energy(folded(angle).X) == pytest.approx(expected, rel=1e-9, abs=1e-16)


def test_fold_from_either_side():
    """Which way is up does not matter for a flat rest state: folds of either sign store the same."""
    problem = hung(BENDINGS[0], folded(0.0), gravity=(0, 0, 0))
    assert problem.energy(folded(0.7).X) == pytest.approx(problem.energy(folded(0.7, -1.0).X), rel=1e-12)


def test_arctangent():
    """To rounding in both precisions, in all quadrants, on the axes and at the origin."""
    of = njit(lambda y, x: arctan2(y, x))
    rng = np.random.default_rng(0)
    r, phi = 10 ** rng.uniform(-6, 6, 4000), rng.uniform(-np.pi, np.pi, 4000)
    points = [*zip(r * np.sin(phi), r * np.cos(phi)), (0, 1), (1, 0), (0, -1), (-1, 0), (1e-9, 1), (1e-9, -1), (0, 0)]
    for real in (np.float32, np.float64):
        worst = 0.0
        for y, x in points:
            exact = math.atan2(real(y), real(x))
            worst = max(worst, abs(float(of(real(y), real(x))) - exact) / max(abs(exact), 1e-300))
        assert worst < 4 * np.finfo(real).eps


# ------------------------------------------------------------------------------------------------------- sweep, block


@pytest.mark.parametrize(("omega", "paper"), [(1.0, False), (1.7, False), (1.0, True)])
@pytest.mark.parametrize("amount", [0.02, 0.2])
def test_sweep_equals_oracle(omega, paper, amount):
    """Node by node to 1e-12, in one kernel with solids."""
    problem = wardrobe()
    assert len({g.term for g in problem.groups}) == 5
    assert against_oracle(problem, crumpled(problem, amount), omega, paper) < 1e-12


def test_sweep_in_float32():
    problem = hung(BENDINGS[3])
    assert against_oracle(problem, crumpled(problem, 0.05), dtype=np.float32) < 5e-6


def psi(F):
    """Energy and stress of CLOTH at F (3, 2)."""
    columns, numbers = tuple(map(tuple, F.T)), CLOTH.parameters()
    return pbng.Membrane.energy(columns, *numbers), np.array(pbng.Membrane.stress(columns, *numbers)).T


def test_block_of_a_membrane_is_a_majoriser(rng):
    """For any displacement of one vertex, from any state, flat and collapsed ones too; the paper's block is none."""
    a, b, _ = CLOTH.block()
    violated = {"own": 0, "paper": 0}
    for case in range(2000):
        F = rng.normal(size=(3, 2)) * 10 ** rng.uniform(-2, 0.5)
        if case % 10 == 0:
            F = np.outer(F[:, 0], rng.normal(size=2))
        if case % 100 == 0:
            F = np.zeros((3, 2))
        g = rng.normal(size=2)
        before, P = psi(F)
        m, v = np.cross(F[:, 0], F[:, 1]), g[0] * F[:, 1] - g[1] * F[:, 0]
        c = np.cross(m, v) / max(np.linalg.norm(m), 1e-300)
        own, paper = v @ v * np.eye(3) - np.outer(v, v), np.outer(c, c)
        for _ in range(4):
            u = rng.normal(size=3) * 10 ** rng.uniform(-2, 0.7)
            after = psi(F + np.outer(u, g))[0]
            for name, block in (("own", own), ("paper", paper)):
                bound = before + u @ P @ g + 0.5 * (a * (g @ g) * u @ u + b * u @ block @ u)
                violated[name] += after > bound + 1e-10 * (after + before)
    assert violated["own"] == 0
    assert violated["paper"] > 100


def hinge_updates(amount, paper, omega, rng, n=4000):
    """Share of updates of single hinges' vertices that raise their energy."""
    base = np.array([[0, 0, 0], [1, 0, 0], [0.5, 0, 0.8], [0.5, 0, -0.8]])
    mesh = pbng.TriMesh(
        (base + 3.0 * np.arange(n)[:, None, None] * [1, 0, 0]).reshape(-1, 3),
        (np.array([[0, 1, 2], [1, 0, 3]]) + 4 * np.arange(n)[:, None, None]).reshape(-1, 3),
    )
    scene = pbng.Scene()
    scene.add(mesh, pbng.Membrane(E=1e-6, nu=0.0), pbng.Bending(k=1.0))
    problem = scene.compile(free=True)
    x = problem.X + rng.normal(0, amount, problem.X.shape)
    packed = pack_problem(problem, np.float64, paper)
    flat, raised, total = packed.pack(x), 0, 0

    def energy():
        x0, x1, x2, x3 = packed.unpack(flat).reshape(n, 4, 3).transpose(1, 0, 2)
        e, a, b = x1 - x0, x2 - x0, x3 - x0
        n1, n2 = np.cross(e, a), np.cross(b, e)
        sine = -np.linalg.norm(e, axis=1) * (n1 * b).sum(1)
        return np.arctan2(sine, (n1 * n2).sum(1)) ** 2

    for color in range(packed.n_color):
        flat = packed.pack(x)
        before = energy()
        sweep(packed, flat, np.array([color]), omega)
        after = energy()
        raised += int((after > before * (1 + 1e-9)).sum())
        total += n
    return raised / total


@pytest.mark.parametrize("omega", [1.0, 1.9])
@pytest.mark.parametrize("amount", [0.05, 0.5])
def test_updates_of_a_hinge_lower_its_energy(amount, omega):
    """Gently and wildly bent; the paper's rank-one block raises it in some cases."""
    assert hinge_updates(amount, False, omega, np.random.default_rng(1)) == 0


def test_papers_block_of_a_hinge_may_raise_its_energy():
    assert hinge_updates(0.5, True, 1.0, np.random.default_rng(1)) > 0.01


@pytest.mark.parametrize("omega", [1.0, 1.95])
@pytest.mark.parametrize("start", ["scrambled", "plane", "line", "point"])
@pytest.mark.parametrize("bending", [None, BENDINGS[0], BENDINGS[3]])
def test_energy_never_rises(bending, start, omega):
    """From crumpled and collapsed states, for bending as stiff as cloth has it: k far below E h²."""
    problem = hung(bending)
    x = hard_start(problem, start)
    E, _ = energies(problem, x + 1e-3 * crumpled(problem, 1.0) * ~problem.fixed[:, None], 60, omega)
    assert rise(E) < 1e-12
    assert E[-1] < 0.5 * E[0]


@pytest.mark.parametrize("start", ["scrambled", "point"])
def test_anderson_never_raises_the_energy(start):
    problem = hung(BENDINGS[1])
    method = pbng.PBNG(dtype="float64").set_up(problem)
    method.start(hard_start(problem, start))
    E = [method.certify().energy]
    for _ in range(60):
        method.step()
        method.settle()
        E.append(method.certify().energy)
    assert rise(np.array(E)) < 1e-12


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_degenerate_triangles_stay_finite(dtype):
    """Triangles without area, edges without length, everything at one point: energy, forces and updates are finite."""
    for bending in BENDINGS:
        problem = hung(bending)
        flat = problem.X * [1, 0, 0]
        needle = problem.X.copy()
        needle[problem.groups[0].cells[4, 1]] = needle[problem.groups[0].cells[4, 0]]
        for x in (flat, needle, np.zeros_like(flat), problem.X * 1e-7, np.repeat(flat[:1], len(flat), 0)):
            x = np.where(problem.fixed[:, None], problem.X, x)
            assert np.isfinite(problem.energy(x))
            assert np.isfinite(problem.forces(x)).all()
            packed = pack_problem(problem, dtype)
            state = packed.pack(x)
            for _ in range(5):
                sweep(packed, state, np.arange(packed.n_color))
                assert np.isfinite(state).all()
                assert np.abs(state).max() < 100


@pytest.mark.parametrize("bending", [None, BENDINGS[3]])
def test_compounds_of_cloth(bending):
    """A sheet tied by stiff springs to another one: the compounds' updates are the oracle's, and lower the energy."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    upper = scene.add(bumpy((5, 4)), CLOTH, bending, at=(0, 0.1, 0))
    lower = scene.add(bumpy((5, 4), seed=6), CLOTH, bending)
    scene.pin(upper.where(np.arange(4)))
    scene.bind(lower.where(np.arange(4, 12)), upper.where(np.arange(4, 12)), k=1e8)
    problem = scene.compile()
    compounds, packed = Compounds(problem), pack_problem(problem, np.float64)
    assert compounds.n >= 8
    x = crumpled(problem, 0.02)
    flat = packed.pack(x)
    sweep(packed, flat, np.arange(packed.n_color), 1.3)
    nodes = [i for c in range(packed.n_color) for i in np.flatnonzero(problem.color == c)]
    expected = oracle.sweep(problem, x, nodes, 1.3)
    for i in np.argsort(compounds.color, kind="stable"):
        expected = oracle.move_compound(problem, expected, compounds.beta[i].toarray()[0], 1.3)
    np.testing.assert_allclose(packed.unpack(flat), expected, atol=1e-11)
    E, _ = energies(problem, x, 60)
    assert rise(E) < 1e-12
