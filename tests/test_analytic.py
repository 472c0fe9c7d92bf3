"""Discrete equilibria against solutions known in closed form (design test 4)."""

from dataclasses import replace

import numpy as np
import pytest
from models import oracle_stress
from scipy.optimize import brentq

import pbng

E, NU = 1e5, 0.3
EXACT = pbng.PBNG(dtype="float64")
TIGHT = pbng.Budget(rtol=1e-11, iterations=3000)


def box(n, size=(1.0, 1.0, 1.0), shake=0.0):
    """A box whose interior vertices are shaken by a share of the spacing."""
    mesh = pbng.shapes.box(size, n)
    return pbng.TetMesh(mesh.X + shaken(mesh, shake), mesh.cells)


def rectangle(n, size=(1.0, 1.0), shake=0.0):
    mesh = pbng.shapes.rectangle(size, n)
    return pbng.TriMesh(mesh.X + shaken(mesh, shake) * [1, 1, 0], mesh.cells)


def shaken(mesh, share):
    rng, spacing = np.random.default_rng(5), np.min(np.linalg.norm(np.diff(mesh.X[mesh.edges], axis=1), axis=2))
    inner = np.ones(mesh.n_vert, bool)
    inner[boundary(mesh)] = False
    return np.where(inner[:, None], rng.uniform(-share, share, mesh.X.shape) * spacing, 0.0)


def boundary(mesh):
    return np.unique(mesh.surface if isinstance(mesh, pbng.TetMesh) else mesh.boundary_edges)


A = np.array([[1.25, 0.15, 0.0], [-0.1, 0.9, 0.2], [0.05, 0.0, 1.1]])
A_PLANE = np.array([[1.25, 0.15, 0.0], [-0.1, 0.9, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    ("model", "plane"),
    [(pbng.Corotated, False), (pbng.NeoHookean, False), (pbng.LinearElastic, False), (pbng.Corotated, True)],
)
def test_patch(model, plane):
    """An affine motion of the boundary makes the same affine motion of every interior vertex an equilibrium."""
    mesh, L = (rectangle(6, shake=0.2), A_PLANE) if plane else (box((5, 4, 4), shake=0.15), A)
    scene = pbng.Scene()
    body = scene.add(mesh, model(E=E, nu=NU))
    scene.move(body.where(boundary(mesh)), lambda t, X: X @ L.T + [0.3, -0.2, 0.0])
    problem = scene.compile()
    expected = problem.X @ L.T + [0.3, -0.2, 0.0]
    assert problem.residual(expected) < 1e-11 * E
    result = pbng.solve(problem, EXACT, TIGHT)
    assert result.status is pbng.Status.CONVERGED
    np.testing.assert_allclose(result.x, expected, atol=1e-9)
    assert (~problem.fixed).sum() >= 12


def homogeneous(mesh, material, F):
    """Equilibrium of a body held at x = 0 in the shape F gives it, under the tractions P N on every other face."""
    scene = pbng.Scene()
    body = scene.add(mesh, material)
    scene.move(body.where(x=0.0), lambda t, X: X @ F.T)
    P = oracle_stress(material, F[None])[0]
    low, high = mesh.X.min(0), mesh.X.max(0)
    for axis in range(2 if isinstance(mesh, pbng.TriMesh) else 3):
        for side, at in ((-1, low), (1, high)):
            if (axis, side) != (0, -1):
                scene.traction(body.where(**{"xyz"[axis]: at[axis]}), side * P[:, axis])
    return pbng.solve(scene, EXACT, TIGHT), P


def uniaxial(material, stretch, plane=False):
    """F of uniaxial stress along x: the stretch across makes P₂₂ (and in space P₃₃ = P₂₂) vanish."""

    def F(across):
        return np.diag([stretch, across, 1.0 if plane else across])

    return F(brentq(lambda s: oracle_stress(material, F(s)[None])[0, 1, 1], 0.3, 2.0, xtol=1e-15))


def test_uniaxial_linear():
    """Linear elasticity: ε_x = T/E, ε_y = ε_z = -ν T/E (38)-(39)."""
    m, mesh = pbng.LinearElastic(E=E, nu=NU), box((6, 3, 3), (2.0, 0.7, 0.7))
    F = np.diag([1.02, 1 - NU * 0.02, 1 - NU * 0.02])
    result, P = homogeneous(mesh, m, F)
    np.testing.assert_allclose(P, np.diag([0.02 * E, 0, 0]), atol=1e-9 * E)
    np.testing.assert_allclose(result.x, mesh.X @ F.T, atol=1e-9)


def test_uniaxial_in_plane_strain():
    """Corotated in plane strain, exactly; for a small strain T = E/(1 - ν²) ε_x and ε_y = -ν/(1 - ν) ε_x."""
    m, mesh = pbng.Corotated(E=E, nu=NU), rectangle((9, 4), (2.0, 0.7))
    F = uniaxial(m, 1.3, plane=True)
    result, _ = homogeneous(mesh, m, F)
    np.testing.assert_allclose(result.x, mesh.X @ F.T, atol=1e-8)
    F = uniaxial(m, 1 + 1e-6, plane=True)
    assert oracle_stress(m, F[None])[0, 0, 0] == pytest.approx(E / (1 - NU**2) * 1e-6, rel=1e-5)
    assert F[1, 1] - 1 == pytest.approx(-NU / (1 - NU) * 1e-6, rel=1e-5)


@pytest.mark.parametrize("stretch", [1.6, 0.85])
def test_uniaxial_neo_hookean(stretch):
    """Neo-Hookean (8) drawn out to 1.6 and pressed to 0.85 of its length (too little to buckle) by the stress P(F)."""
    m, mesh = pbng.NeoHookean(E=E, nu=NU), box((4, 4, 4))
    F = uniaxial(m, stretch)
    result, P = homogeneous(mesh, m, F)
    np.testing.assert_allclose(P - np.diag([P[0, 0], 0, 0]), 0, atol=1e-9 * E)
    np.testing.assert_allclose(result.x, mesh.X @ F.T, atol=1e-8)
    s, a, lam_hat = stretch, F[1, 1], m.lam + m.mu
    by_hand = m.mu * s + (lam_hat * (s * a * a - 1) - m.mu) * a * a
    assert P[0, 0] == pytest.approx(by_hand)


@pytest.mark.parametrize("model", [pbng.Corotated, pbng.NeoHookean])
def test_simple_shear(model):
    """Simple shear x + γ y under the tractions P N of the homogeneous state."""
    F = np.eye(3)
    F[0, 1] = 0.3
    mesh = box((5, 4, 3), (1.0, 0.8, 0.5))
    result, P = homogeneous(mesh, model(E=E, nu=NU), F)
    if model is pbng.NeoHookean:  # J = 1: P = μ (F - F^{-T})
        np.testing.assert_allclose(P, model(E=E, nu=NU).mu * (F - np.linalg.inv(F).T), atol=1e-9 * E)
    np.testing.assert_allclose(result.x, mesh.X @ F.T, atol=1e-8)


def test_bar_under_its_own_weight():
    """ν = 0: u = ρg/E (L x - x²/2), exact in the mean over every section of vertices, whatever the mesh in between.

    The section's mean is that of the finite element functions, ∫u dA / A; a trial function of x alone shows it.
    """
    length, density, g = 2.0, 1000.0, 9.8
    mesh = pbng.shapes.box((length, 0.6, 0.6), (9, 4, 4))
    scene = pbng.Scene(gravity=(g, 0.0, 0.0))
    body = scene.add(mesh, pbng.LinearElastic(E=1e6, nu=0.0, density=density))
    scene.pin(body.where(x=0.0))
    result = pbng.solve(scene, EXACT, TIGHT)
    u = result.x - mesh.X
    for x in np.unique(mesh.X[:, 0]):
        here = mesh.X[:, 0] == x
        faces = section(mesh, here)
        area = np.linalg.norm(np.cross(*(mesh.X[faces[:, k]] - mesh.X[faces[:, 0]] for k in (1, 2))), axis=1) / 2
        mean = area @ u[faces, 0].mean(1) / area.sum()
        assert area.sum() == pytest.approx(0.36)
        assert mean == pytest.approx(density * g / 1e6 * (length * x - x * x / 2), abs=1e-11)
    assert np.abs(u[:, 0] - density * g / 1e6 * (length * mesh.X[:, 0] - mesh.X[:, 0] ** 2 / 2)).max() < 1e-3


def section(mesh, here):
    """Triangles of the mesh whose vertices all lie in a section, each once."""
    local = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
    faces = np.sort(mesh.cells[:, local].reshape(-1, 3), axis=1)
    return np.unique(faces[here[faces].all(1)], axis=0)


def bent(X):
    """A smooth deformation x(X) of the unit square or cube, not in the finite element space, with strains up to 0.4."""
    x, y, z = X.T
    wave = np.sin(np.pi * x) * np.cos(np.pi * y / 2) * (1 + 0.5 * z)
    return X + 0.1 * np.stack([wave, x * x + np.sin(2 * y) * (1 - x), 0 * z], axis=1) + 0.05 * np.stack(
        [0 * z, 0 * z, z * np.cos(2 * x)], axis=1
    )  # fmt: skip


def body_force(material, X, plane):
    """-Div P(∂x/∂X) [N/m³] at X (n, 3) by central differences, P from the oracle."""
    axes = range(2 if plane else 3)

    def gradient(X, h=1e-4):
        F = np.zeros((len(X), 3, 3))
        F[:, 2, 2] = 1
        for j in axes:
            F[:, :, j] = (bent(X + h * np.eye(3)[j]) - bent(X - h * np.eye(3)[j])) / (2 * h)
        return F

    h = 1e-3
    force = np.zeros_like(X)
    for j in axes:
        step = h * np.eye(3)[j]
        up, down = (oracle_stress(material, gradient(X + s * step)) for s in (1, -1))
        force -= (up - down)[:, :, j] / (2 * h)
    return force


def manufactured_error(mesh, material):
    """Root mean square error [m] of the vertices of the manufactured problem."""
    plane = isinstance(mesh, pbng.TriMesh)
    scene = pbng.Scene()
    body = scene.add(mesh, material)
    scene.move(body.where(boundary(mesh)), lambda t, X: bent(X))
    problem = scene.compile()
    volume = problem.mass[:, None] / material.density
    problem = replace(problem, f_ext=volume * body_force(material, problem.X, plane))
    result = pbng.solve(problem, EXACT, pbng.Budget(rtol=1e-8, iterations=3000))
    assert result.status is pbng.Status.CONVERGED
    return float(np.sqrt(np.mean((result.x - bent(problem.X))[~problem.fixed] ** 2)))


def test_order_of_convergence_of_triangles():
    """Linear triangles: the error falls as h² under refinement, finite strain included."""
    m = pbng.Corotated(E=E, nu=NU)
    errors = [manufactured_error(rectangle(n), m) for n in (5, 9, 17)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (np.abs(orders - 2) < 0.25).all(), (errors, orders)


def test_order_of_convergence_of_tets():
    """Linear tets: h² as well."""
    m = pbng.NeoHookean(E=E, nu=NU)
    errors = [manufactured_error(box(n), m) for n in (9, 17)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.25), errors
