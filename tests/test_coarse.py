"""The coarse space as a solver uses it: directions, extensions, hard cases, determinism."""

import numba
import numpy as np
import pytest
from conftest import hard_start, held_box
from grids import SOFT, coarse_space, shaken, u_shape
from models import polar

import pbng
from pbng.coarse import space
from pbng.coarse.linear import interpolation


def force_on(problem, packed, rng):
    """A force on every free vertex, in plane ones in their plane, and NaN where nothing should look."""
    f = rng.standard_normal((problem.n_vert, 3))
    for g in problem.groups:
        if g.kind.name == "triangle":
            f[g.cells, 2] = 0
    out = np.zeros((packed.n_free // 4, 4))
    out[:, 3] = np.nan
    at = packed.slot[~problem.fixed]
    out[at, :3] = f[~problem.fixed]
    return out.ravel()


def check_direction(problem, coarse, packed, rng):
    """d = U y with UᵀHU y = Uᵀf, zero in padding; returns d (n_vert, 3), zero where constrained."""
    f, d = force_on(problem, packed, rng), np.full(packed.n_free, np.nan)
    slope = coarse.direction(f, d, 1e-12)
    rows, moves, at = d.reshape(-1, 4), ~problem.fixed, packed.slot[~problem.fixed]
    padding = np.setdiff1d(np.arange(len(rows)), at)
    assert len(padding)
    np.testing.assert_array_equal(rows[padding], 0)
    np.testing.assert_array_equal(rows[:, 3], 0)
    assert slope == pytest.approx(np.nansum(f * d), rel=1e-9)
    assert slope > 0
    U = interpolation(coarse.grids[0]).toarray()[moves]
    A = coarse.solver.matrices[0].sparse().toarray()
    y = np.linalg.solve(A, (U.T @ f.reshape(-1, 4)[at, :3]).ravel()).reshape(-1, 3)
    np.testing.assert_allclose(rows[at, :3], U @ y, atol=1e-6 * np.abs(rows).max())
    out = np.zeros((problem.n_vert, 3))
    out[moves] = rows[at, :3]
    return out


def test_direction(tower, rng):
    """On three levels: U (UᵀHU)⁻¹ Uᵀ f at free vertices, zero elsewhere; the returned slope is f·d > 0."""
    coarse, packed = tower
    check_direction(coarse.problem, coarse, packed, rng)


def test_direction_of_several_bodies(mixed, rng):
    """The same with plane bodies, several materials and one grid; plane bodies stay in their plane."""
    coarse, packed = coarse_space(mixed)
    coarse.refresh(packed.pack(mixed.X))
    d = check_direction(mixed, coarse, packed, rng)
    plane = np.concatenate([np.arange(b.start, b.stop) for b in mixed.bodies if b.mesh.cells.shape[1] == 3])
    assert (d[plane, 2] == 0).all()
    assert np.abs(d[plane, :2]).max() > 0


def test_direction_ignores_forces_across_a_plane(rng):
    """A force along z on a plane body moves nothing, and does no work."""
    scene = pbng.Scene()
    plate = scene.add(pbng.shapes.rectangle((2.0, 1.0), (17, 9)), SOFT)
    scene.pin(plate.where(x=0.0))
    problem = scene.compile()
    coarse, packed = coarse_space(problem)
    coarse.refresh(packed.pack(problem.X))
    check_direction(problem, coarse, packed, rng)
    f, d = np.zeros(packed.n_free), np.empty(packed.n_free)
    f.reshape(-1, 4)[packed.slot[~problem.fixed], 2] = 1.0
    assert coarse.direction(f, d, 1e-12) == 0
    assert (d == 0).all()


def test_direction_takes_out_a_smooth_load():
    """A bar under an even pull: one direction gains most of the energy, though few elements are sampled."""
    scene = pbng.Scene()
    bar = scene.add(pbng.shapes.box((4.0, 1.0, 1.0), (33, 9, 9)), pbng.LinearElastic(E=1e5, nu=0.0))
    scene.pin(bar.where(x=0.0))
    scene.traction(bar.where(x=4.0), (1e3, 0, 0))
    problem = scene.compile()
    coarse, packed = coarse_space(problem)
    coarse.refresh(packed.pack(problem.X))
    f, d = packed.pack(problem.f_ext)[: packed.n_free].copy(), np.empty(packed.n_free)
    slope = coarse.direction(f, d, 1e-10)
    u = np.zeros(problem.X.shape)
    u[~problem.fixed] = d.reshape(-1, 4)[packed.slot[~problem.fixed], :3]
    assert slope == pytest.approx(np.sum(problem.f_ext * u), rel=1e-9)
    equilibrium = problem.X * [0.01, 0, 0]  # strain is traction / E
    assert problem.energy(problem.X + u) < 0.8 * problem.energy(problem.X + equilibrium) < 0


def stretched_bar(end=(0.0, 0.0, 0.0)):
    """A bar prescribed at both ends, and the displacements of its prescribed vertices for a displacement of one end."""
    scene = pbng.Scene()
    bar = scene.add(pbng.shapes.box((3.0, 1.0, 1.0), (25, 9, 9)), SOFT)
    scene.pin(bar.where(x=0.0))
    scene.move(bar.where(x=3.0), pbng.Translate(end))
    problem = scene.compile()
    return problem, (problem.prescribed(problem.end) - problem.X[problem.fixed])


@pytest.mark.parametrize("most", [6000, 20], ids=["finest grid", "coarser grid"])
def test_extension_of_a_translation(most, monkeypatch, small_bottom):
    """Constraints that all move alike carry the body along."""
    monkeypatch.setattr(space, "EXTENSION", most)
    problem, _ = stretched_bar()
    coarse, _ = coarse_space(problem)
    by = np.array([0.3, -0.2, 0.1])
    u = coarse.extend(np.broadcast_to(by, (problem.fixed.sum(), 3)))
    assert u.shape == (problem.n_vert, 3)
    np.testing.assert_allclose(u, np.broadcast_to(by, u.shape), atol=1e-2 * np.linalg.norm(by))


@pytest.mark.parametrize(("most", "allowed"), [(6000, 0.01), (20, 0.1)], ids=["finest grid", "coarser grid"])
def test_extension_between_two_ends(most, allowed, monkeypatch, small_bottom):
    """A bar drawn out at one end stretches nearly evenly; less so where cells reach beyond it."""
    monkeypatch.setattr(space, "EXTENSION", most)
    problem, increment = stretched_bar((0.4, 0.0, -0.2))
    coarse, _ = coarse_space(problem)
    u = coarse.extend(increment)
    want = problem.X[:, :1] / 3 * [0.4, 0.0, -0.2]
    np.testing.assert_allclose(u, want, atol=allowed * np.linalg.norm([0.4, 0.2]))


def test_extension_stays_in_its_body():
    """Other bodies, held or loose, stay; and a leg of a U moves without the other."""
    mesh = u_shape()
    scene = pbng.Scene()
    body = scene.add(mesh, SOFT)
    other = scene.add(mesh, SOFT, at=(0.5, 0.0, 0.0))
    scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 5), SOFT)
    scene.pin(body.where(y=0.0))
    scene.pin(other.where(y=0.0))
    scene.move(body.where(x=(0, 2), y=8.0), pbng.Translate((0.0, 0.0, 1.0)))
    problem = scene.compile()
    coarse, _ = coarse_space(problem)
    u = coarse.extend(problem.prescribed(problem.end) - problem.X[problem.fixed])
    np.testing.assert_allclose(u[mesh.n_vert :], 0, atol=1e-9)
    np.testing.assert_allclose(u[mesh.where(x=(0, 2), y=8.0)], np.broadcast_to([0, 0, 1.0], (9, 3)), atol=0.05)
    assert np.abs(u[mesh.where(x=(4, 6), y=8.0)]).max() < 0.25


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one thread only")
def test_same_bits_for_one_and_two_threads(small_bottom, rng):
    """Stiffness, direction, its slope and the extension do not depend on the number of threads."""
    problem = held_box(SOFT, (24, 24, 24), (1.0, 1.0, 1.0))
    coarse, packed = coarse_space(problem)
    assert len(coarse.grids) == 4
    x, f = packed.pack(shaken(problem, 1.0, 0.02)), force_on(problem, packed, rng)
    increment = rng.standard_normal((problem.fixed.sum(), 3))
    found, before = [], numba.get_num_threads()
    try:
        for threads in (1, 2, 1):
            numba.set_num_threads(threads)
            d = np.empty(packed.n_free)
            coarse.refresh(x)
            slope = coarse.direction(f, d, 1e-6)
            found.append((coarse.cubature.stiffness.tobytes(), d.tobytes(), slope, coarse.extend(increment).tobytes()))
    finally:
        numba.set_num_threads(before)
    assert found[0] == found[1] == found[2]


def single_tet(X, pins):
    scene = pbng.Scene()
    body = scene.add(pbng.TetMesh(X, [[0, 1, 2, 3]]), SOFT)
    scene.pin(body.where(np.arange(pins)))
    return scene.compile()


def check_finite(problem, rng):
    """A direction at rest and from hard starts: finite and uphill, zero at most in rounding."""
    coarse, packed = coarse_space(problem)
    for x in (problem.X, hard_start(problem, "point"), hard_start(problem, "scrambled")):
        coarse.refresh(packed.pack(x))
        f, d = force_on(problem, packed, rng), np.full(packed.n_free, np.nan)
        slope = coarse.direction(f, d, 0.1)
        assert np.isfinite(slope)
        assert slope > 0
        assert np.isfinite(d).all()
    assert np.isfinite(coarse.extend(rng.standard_normal((problem.fixed.sum(), 3)))).all()


# Where the elements of a piece feel fewer directions than its corners have, or nothing holds a body, the sum over
# pieces is singular; a shift makes it definite.
UNIT = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])


@pytest.mark.parametrize("pins", [1, 2, 3])
def test_single_tet_along_the_axes(pins, rng):
    """Its corners are corners of the one cell; four nodes move nothing."""
    check_finite(single_tet(UNIT, pins), rng)


@pytest.mark.parametrize("pins", [1, 2, 3])
def test_single_tet(pins, rng):
    """One tet askew in its cell: 24 directions of the nodes, of which it feels nine."""
    check_finite(single_tet(np.random.default_rng(pins).random((4, 3)), pins), rng)


@pytest.mark.parametrize("seed", [22, 37, 46])
def test_thin_plate_askew(seed, rng):
    """A plate one layer of cells thick, turned: some pieces hold a few elements only."""
    box = pbng.shapes.box((1.0, 1.0, 0.1), (12, 12, 2))
    turn = polar(np.random.default_rng(seed).standard_normal((1, 3, 3)))[0]
    scene = pbng.Scene()
    body = scene.add(pbng.TetMesh(box.X @ turn.T, box.cells), SOFT)
    scene.pin(body.where(box.X[:, 0] == 0))
    check_finite(scene.compile(), rng)


def test_loose_body(rng):
    """A scene may hold a body that nothing holds (it warns); directions stay finite."""
    scene = pbng.Scene()
    held = scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 5), SOFT)
    scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 5), SOFT, at=(3.0, 0.0, 0.0))
    scene.pin(held.where(x=0.0))
    check_finite(scene.compile(), rng)


@pytest.mark.filterwarnings("error")
def test_nothing_is_free():
    """A body all of whose vertices are prescribed has no direction, and gives no warning."""
    scene = pbng.Scene()
    body = scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 3), SOFT)
    scene.pin(body.where())
    problem = scene.compile()
    coarse, packed = coarse_space(problem)
    coarse.refresh(packed.pack(problem.X))
    assert coarse.direction(np.empty(0), np.empty(0), 0.1) == 0
    by = np.random.default_rng(0).standard_normal((problem.n_vert, 3))
    assert np.isfinite(coarse.extend(by)).all()


def test_material_that_cannot_move(rng):
    """All elements of one of two materials are held: nothing is sampled of it."""
    box = pbng.shapes.box((2.0, 1.0, 1.0), (9, 5, 5))
    low = box.X[box.cells][:, :, 0].max(1) <= 1.0
    scene = pbng.Scene()
    body = scene.add(
        pbng.TetMesh(box.X, box.cells, cell_groups={"a": low, "b": ~low}),
        {"a": pbng.NeoHookean(E=1e5, nu=0.3), "b": SOFT},
    )
    scene.pin(body.where(x=(0.0, 1.0)))
    check_finite(scene.compile(), rng)
