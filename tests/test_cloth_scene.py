"""Cloth in scenes: what it is made of, equilibria against theory and against Newton's method, bad input."""

import math
from dataclasses import replace

import numba
import numpy as np
import pytest
from test_cloth import BENDINGS, CLOTH, crumpled, hung, wardrobe

import pbng
from pbng.stiffness import StiffnessMatrix

FLESH = pbng.Corotated(E=2e5, nu=0.3, density=100.0)


def test_what_a_sheet_is_made_of():
    """Triangles and hinges, masses a third of density times area each, gravity in z too, all of it for a surface."""
    mesh = pbng.shapes.sheet((2.0, 1.0), (5, 4))
    scene = pbng.Scene(gravity=(0.0, -9.8, 3.0))
    cloth = scene.add(mesh, pbng.Membrane(E=1e3, nu=0.3, density=0.4), pbng.Bending(k=0.05), name="cloth", at=(0, 1, 0))
    scene.pin(cloth.where(x=0.0))
    scene.traction(cloth.where(), (0.0, 0.5, 0.0))
    problem = scene.compile()
    assert [g.kind.name for g in problem.groups] == ["membrane", "hinge"]
    assert len(problem.groups[1].cells) == len(mesh.edges) - len(mesh.boundary_edges)
    assert problem.mass.sum() == pytest.approx(0.8)
    corner = int(cloth.where(x=0.0, z=0.0).vertices[0])
    share = mesh.volume[(mesh.cells == corner).any(1)].sum() / 3
    assert problem.mass[corner] == pytest.approx(0.4 * share)
    np.testing.assert_allclose(problem.f_ext.sum(0), [0, 0.8 * -9.8 + 0.5 * 2, 0.8 * 3])
    np.testing.assert_array_equal(cloth.faces, mesh.cells)
    assert cloth.is_cloth


def test_sheet():
    """Level, its normals up; a rectangle of the same grid stays what it was."""
    mesh = pbng.shapes.sheet((2.0, 1.0), (5, 4), origin=(1.0, 2.0, 3.0))
    np.testing.assert_allclose([mesh.X.min(0), mesh.X.max(0)], [[1, 2, 3], [3, 2, 4]])
    a, b, c = (mesh.X[mesh.cells[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 1] > 0).all()
    assert mesh.volume.sum() == pytest.approx(2.0)
    assert len(mesh.hinges) == len(mesh.edges) - len(mesh.boundary_edges)


def test_hinges_are_pairs_of_triangles():
    """Each has the first triangle's orientation along its edge, and the other's against it."""
    mesh = pbng.shapes.sheet((1.0, 1.0), (4, 3))
    triangles = {frozenset(t.tolist()) for t in mesh.cells}
    directed = {(int(t[k]), int(t[(k + 1) % 3])) for t in mesh.cells for k in range(3)}
    for a, b, c, d in mesh.hinges.tolist():
        assert {frozenset((a, b, c)), frozenset((a, b, d))} <= triangles
        assert {(a, b), (b, c), (b, a), (a, d)} <= directed


def test_thickness():
    """E [Pa] with a thickness is E times thickness [N/m] without one."""
    thick, thin = pbng.Membrane(E=1e6, nu=0.3, thickness=1e-3), pbng.Membrane(E=1e3, nu=0.3)
    assert thick.parameters() == pytest.approx(thin.parameters())
    assert (thick.mu, thick.lam) == pytest.approx((1e3 / 2.6, 1e3 * 0.3 / (1.3 * 0.4)))


# -------------------------------------------------------------------------------------------------------- equilibria


def test_strip_under_its_own_weight():
    """nu = 0: the tension E (s - 1) carries what hangs below, and the end sinks by ρ g L²/(2 E), however far."""
    E, density, g = 10.0, 0.5, 9.8
    scene = pbng.Scene(gravity=(0, -g, 0))
    mesh = pbng.shapes.rectangle((0.2, 1.0), (3, 11))
    strip = scene.add(mesh, pbng.Membrane(E=E, nu=0.0, density=density), pbng.Bending(k=1e-3))
    scene.pin(strip.where(y=1.0))
    result = pbng.solve(scene, pbng.PBNG(dtype="float64"), pbng.Budget(rtol=1e-9, iterations=2000))
    assert result.status is pbng.Status.CONVERGED
    sunk = -result.x[strip.where(y=0.0).index, 1]
    np.testing.assert_allclose(sunk, density * g / (2 * E), rtol=2e-3)


def test_stretched_sheet():
    """Uniaxial stress: a free strip narrows by nu/(1-nu) of its strain, as stiff as E/(1-nu²) (docs/materials.md)."""
    E, nu, strain = 1e3, 0.3, 1e-3
    scene = pbng.Scene()
    strip = scene.add(pbng.shapes.sheet((2.0, 0.5), (17, 5)), pbng.Membrane(E=E, nu=nu))
    scene.pin(strip.where(x=0.0))
    scene.move(strip.where(x=2.0), pbng.Translate((2.0 * strain, 0, 0)))
    problem = scene.compile()
    result = pbng.solve(problem, pbng.Newton(), pbng.Budget(rtol=1e-8))
    gauge = [strip.where(x=x).index for x in (0.75, 1.25)]
    along = (result.x[gauge[1], 0].mean() - result.x[gauge[0], 0].mean()) / 0.5 - 1
    across = np.ptp(result.x[strip.where(x=1.0).index, 2]) / 0.5 - 1
    force = problem.forces(result.x)[strip.where(x=0.0).index, 0].sum()
    assert -across / along == pytest.approx(nu / (1 - nu), rel=0.02)
    assert force / (0.5 * along) == pytest.approx(E / (1 - nu**2), rel=0.01)


def rolled(vertices, bending, radius=0.4):
    """A sheet of 1 by 0.5 rolled up along x, and its problem."""
    mesh = pbng.shapes.sheet((1.0, 0.5), vertices)
    scene = pbng.Scene()
    scene.add(mesh, pbng.Membrane(E=1e-9, nu=0.0), bending)
    phi = mesh.X[:, 0] / radius
    x = np.column_stack([radius * np.sin(phi), radius * (1 - np.cos(phi)), mesh.X[:, 2]])
    return scene.compile(free=True), x


@pytest.mark.parametrize("vertices", [(11, 6), (21, 11), (21, 6), (11, 11), (41, 6)])
def test_cylinder(vertices):
    """With the weight a cylinder stores 3 k/2 κ² per area on any grid; without, it depends on the cells' shape."""
    radius, k = 0.4, 0.02
    n, m = vertices
    area = 0.5 * (n - 2) / (n - 1)  # that belongs to the folds
    problem, x = rolled(vertices, pbng.Bending(k=k, weighted=True), radius)
    assert problem.energy(x) == pytest.approx(1.5 * k / radius**2 * area, rel=1e-6)
    problem, x = rolled(vertices, pbng.Bending(k=k), radius)
    shape = (1.0 / (n - 1)) / (0.5 / (m - 1))
    assert problem.energy(x) == pytest.approx(0.5 * k * shape / radius**2 * area, rel=1e-6)


def cantilever(vertices, weighted):
    """Deflection of the end of a strip under a small load there, over that of a beam of rigidity 3 k per width."""
    length, width, k, load = 1.0, 0.2, 1e-3, 1e-5
    h = length / (vertices[0] - 1)
    scene = pbng.Scene()
    material, bending = pbng.Membrane(E=1e3, nu=0.0), pbng.Bending(k=k, weighted=weighted)
    strip = scene.add(pbng.shapes.sheet((length, width), vertices), material, bending)
    scene.pin(strip.where(x=(0.0, h)))
    scene.force(strip.where(x=length), (0.0, -load, 0.0))
    result = pbng.solve(scene, pbng.Newton(), pbng.Budget(rtol=1e-8, iterations=60))
    assert result.status is pbng.Status.CONVERGED
    free = length - h / 2  # a fold stands for half a cell on either side
    return -result.x[strip.where(x=length).index, 1].mean() / (load * free**3 / (9 * k * width))


def test_cantilever():
    """Between the cylinder's rigidity and a quarter less, since diagonals fold too; the same on finer grids."""
    ratio = [cantilever(vertices, True) for vertices in ((11, 3), (21, 5), (41, 9))]
    assert max(ratio) / min(ratio) < 1.05
    assert min(ratio) > 1.0
    assert max(ratio) < 1.25
    assert cantilever((21, 9), True) == pytest.approx(1.0, abs=0.05)
    slender = cantilever((21, 9), False) / cantilever((21, 5), False)
    assert slender < 0.5  # unweighted: cells of half the width make it twice as stiff


def hanging(bending):
    """A sheet that hangs by two corners."""
    mesh = pbng.shapes.sheet((1.0, 0.8), (6, 5))
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    cloth = scene.add(mesh, CLOTH, bending)
    for x in (0.0, 1.0):
        scene.pin(cloth.where(x=x, z=0.0))
    return scene.compile()


@pytest.mark.parametrize("bending", [BENDINGS[0], BENDINGS[1]])
def test_newton_and_pbng_agree(bending):
    """The same equilibrium to 1e-6; PBNG starts near, as cloth hangs into place slowly."""
    problem = hanging(bending)
    exact = pbng.solve(problem, pbng.Newton(), pbng.Budget(rtol=1e-12, iterations=200))
    assert exact.status is pbng.Status.CONVERGED
    assert exact.x[:, 1].min() < -0.3
    start = problem.constrain(exact.x + np.random.default_rng(0).normal(0, 0.02, exact.x.shape), 0.0)
    for solver in (pbng.PBNG(dtype="float64"), pbng.MultigridPBNG(dtype="float64")):
        result = pbng.solve(problem, solver, pbng.Budget(rtol=1e-11, iterations=8000), start=start)
        assert result.status is pbng.Status.CONVERGED
        np.testing.assert_allclose(result.x, exact.x, atol=1e-6)


def test_stiffness_matrix(rng):
    """The matrix is the derivative of the forces to 1e-6, beside solids and for hinges of either kind."""
    problem = wardrobe()
    x = crumpled(problem, 0.1)
    stiffness = StiffnessMatrix(problem)
    stiffness.fill(x)
    step = np.zeros_like(x)
    step[stiffness.vertex] = rng.standard_normal((len(stiffness.vertex), 3))
    plane = next(g for g in problem.groups if g.kind.name == "triangle").cells
    step[plane, 2] = 0
    h = 1e-6
    expected = -(problem.forces(x + h * step) - problem.forces(x - h * step))[stiffness.vertex] / (2 * h)
    found = stiffness.matrix @ step[stiffness.vertex]
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("projection", ["clamp", "abs"])
def test_projected_stiffness(projection):
    """Positive definite where the exact one is not."""
    problem = hung(BENDINGS[3])
    stiffness = StiffnessMatrix(problem)
    x = crumpled(problem, 0.2)
    stiffness.fill(x)
    assert np.linalg.eigvalsh(stiffness.matrix.sparse().toarray())[0] < 0
    stiffness.fill(x, projection)
    assert np.linalg.eigvalsh(stiffness.matrix.sparse().toarray())[0] > 0


def test_cloth_beside_a_solid():
    """A sheet tied to a block hangs and buckles: cycles end where forces balance, no higher than Newton's method."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    block = scene.add(pbng.shapes.box((1.0, 0.3, 0.3), (9, 3, 3)), FLESH)
    flag = scene.add(pbng.shapes.rectangle((0.5, 0.5), 5), CLOTH, BENDINGS[1], at=(0.5, -0.5, 0.0))
    scene.pin(block.where(x=0.0))
    scene.bind(flag.where(y=0.0), block, k=1e2)
    problem = scene.compile()
    exact = pbng.solve(problem, pbng.Newton(), pbng.Budget(rtol=1e-9, iterations=100))
    result = pbng.solve(problem, pbng.MultigridPBNG(dtype="float64"), pbng.Budget(rtol=1e-7, iterations=2000))
    assert exact.status is result.status is pbng.Status.CONVERGED
    assert result.energy <= exact.energy + 1e-9 * abs(exact.energy)
    np.testing.assert_allclose(result.x[: block.mesh.n_vert], exact.x[: block.mesh.n_vert], atol=1e-3)


def test_falling_cloth():
    """Backward Euler: a sheet let go at rest falls as a body does, without strain."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    cloth = scene.add(pbng.shapes.sheet((1.0, 1.0), 5), CLOTH, BENDINGS[0])
    problem = scene.compile(free=True)
    assert cloth.is_cloth
    frames = pbng.simulate(problem, pbng.PBNG(), pbng.Budget(rtol=1e-4), frames=4, fps=10, inertia=True)
    last = list(frames)[-1]
    assert np.ptp(last.x[:, 1]) < 1e-3
    assert last.v[:, 1].mean() == pytest.approx(-9.8 * 0.3, rel=1e-2)


def test_threads():
    """The same bits for one and two threads."""
    problem = hung(BENDINGS[3], pbng.shapes.sheet((1.0, 1.0), 20))
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one thread only")
    found = []
    for threads in (1, 2):
        result = pbng.solve(problem, pbng.PBNG(threads=threads), pbng.Budget(iterations=20))
        found.append((result.x.tobytes(), result.residuals[-1], result.energy))
    assert found[0] == found[1]


# --------------------------------------------------------------------------------------------------- materials, input


@pbng.material
class Net(pbng.Material):
    """A user's surface: springs along both axes of F, μ/2 (|F|² - 2 - 2 log...) left out: μ/2 |F|² - μ J."""

    surface = True

    def energy(F, mu, lam):
        real = type(mu)
        m = pbng.linalg.cross(F[0], F[1])
        square = pbng.linalg.dot(F[0], F[0]) + pbng.linalg.dot(F[1], F[1])
        return real(0.5) * mu * square - mu * math.sqrt(pbng.linalg.dot(m, m))

    def stress(F, mu, lam):
        real = type(mu)
        m = pbng.linalg.cross(F[0], F[1])
        n = pbng.linalg.scale(real(1) / max(math.sqrt(pbng.linalg.dot(m, m)), real(1e-18)), m)
        a, b = pbng.linalg.cross(F[1], n), pbng.linalg.cross(n, F[0])
        return pbng.linalg.combine(mu, F[0], -mu, a), pbng.linalg.combine(mu, F[1], -mu, b)

    def block(self):
        return pbng.Block(self.mu, 0.0)


def test_surface_material_of_ones_own(rng):
    """Energy and stress of two columns; forces, sweeps and the matrix follow."""
    problem = hung(None, material=Net(E=1e3, nu=0.3, density=0.1))
    x = crumpled(problem, 0.1)
    step = rng.standard_normal(x.shape) * ~problem.fixed[:, None]
    h = 1e-6
    slope = (problem.energy(x + h * step) - problem.energy(x - h * step)) / (2 * h)
    assert slope == pytest.approx(-np.sum((problem.forces(x) + problem.f_ext) * step), rel=1e-6)
    stiffness = StiffnessMatrix(problem)
    stiffness.fill(x)
    expected = -(problem.forces(x + h * step) - problem.forces(x - h * step))[stiffness.vertex] / (2 * h)
    found = stiffness.matrix @ step[stiffness.vertex]
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
    result = pbng.solve(problem, pbng.PBNG(None, dtype="float64"), pbng.Budget(iterations=20, every=1), start=x)
    assert (np.diff(result.energies) < 1e-9).all()


def bad_scene(mesh, material, bending=None, **more):
    pbng.Scene().add(mesh, material, bending, name="it", **more)


TETS, SHEET = pbng.shapes.box(vertices=2), pbng.shapes.sheet(vertices=3)
FAN = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0.0]])


@pytest.mark.parametrize(
    ("mesh", "material", "bending", "words"),
    [
        (TETS, CLOTH, None, "'it': Membrane is a material of surfaces, and its mesh is of tets"),
        (TETS, FLESH, pbng.Bending(k=1.0), "'it': bending is for cloth"),
        (pbng.shapes.rectangle(), FLESH, pbng.Bending(k=1.0), "'it': bending is for cloth"),
        (SHEET, FLESH, None, "'it': a solid in two dimensions must lie in a plane of constant z; for cloth"),
        (SHEET, CLOTH, "cloth", r"'it': expected Bending\(k=...\) after the material, not 'cloth'"),
        (
            pbng.TriMesh(FAN, [[0, 1, 2], [1, 0, 3], [0, 1, 4]]),
            CLOTH,
            None,
            r"'it': edge \[0, 1\] belongs to 3 triangles: 0, 1, 2",
        ),
        (
            pbng.TriMesh(FAN[:4], [[0, 1, 2], [0, 1, 3]]),
            CLOTH,
            None,
            r"'it': triangles 0, 1 are not oriented alike: both run the same way along their edge \[0, 1\]",
        ),
    ],
)
def test_bad_cloth_is_named(mesh, material, bending, words):
    with pytest.raises(pbng.InputError, match=words):
        bad_scene(mesh, material, bending)


def test_mixed_surface_and_solid():
    mesh = pbng.shapes.rectangle((1.0, 1.0), 3)
    half = np.arange(mesh.n_elem) % 2 == 0
    mesh = pbng.TriMesh(mesh.X, mesh.cells, cell_groups={"a": half, "b": ~half})
    with pytest.raises(pbng.InputError, match="some of its materials are of surfaces and some are not"):
        bad_scene(mesh, {"a": CLOTH, "b": FLESH})
    scene = pbng.Scene()
    body = scene.add(mesh, {"a": CLOTH, "b": replace(CLOTH, E=2e3)}, pbng.Bending(k=0.0))
    scene.pin(body.where(x=0.0))
    assert [g.kind.name for g in scene.compile().groups] == ["membrane", "membrane"]  # k = 0: no hinges


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: pbng.Bending(k=-1.0), "Bending: k must be finite and not negative, not -1"),
        (lambda: pbng.Bending(k=math.nan), "Bending: k must be finite"),
        (lambda: pbng.Bending(k=1.0, rest="curved"), "rest must be 'flat' or 'mesh', not 'curved'"),
        (lambda: pbng.Membrane(E=1e3, nu=-0.1), "nu must not be negative"),
        (lambda: pbng.Membrane(E=1e3, nu=0.3, thickness=0.0), "thickness must be positive"),
        (lambda: pbng.check_material(CLOTH), "check_material: Membrane is a material of surfaces"),
        (
            lambda: pbng.solve(hung(), pbng.XPBD(), pbng.Budget(iterations=1)),
            "XPBD: constraints are for solids, and Membrane is for cloth",
        ),
        (
            lambda: pbng.solve(hung(), pbng.PBD(), pbng.Budget(iterations=1)),
            "PBD: constraints are for solids, and Membrane is for cloth",
        ),
    ],
)
def test_bad_numbers_are_named(make, words):
    with pytest.raises(pbng.InputError, match=words):
        make()


def test_anisotropic_surfaces_are_refused():
    class Woven(Net):
        isotropic = False

    problem = hung(None, material=Woven(E=1e3, nu=0.3))
    with pytest.raises(pbng.InputError, match="materials of surfaces must be isotropic"):
        pbng.solve(problem, pbng.PBNG(), pbng.Budget(iterations=1))
