"""The same bits for any number of threads, valid colourings, and Table 1 (design test 7)."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import held_box, mixed_problem

import pbng
from pbng.coloring import MAX_COLORS, color_constraints, color_nodes, is_valid, morton
from pbng.packing import pack_problem
from pbng.topology import incidence

THREADS = """
import hashlib, sys
import numpy as np, pbng
from conftest import twisted_bar

scene = twisted_bar(vertices=(22, 15, 15))
digests = set()
for threads in (1, 2, None, 1):
    if sys.argv[2] == "sweeps":
        solver = pbng.PBNG(pbng.Anderson(memory=4), dtype=sys.argv[1], threads=threads)
        budget = pbng.Budget(iterations=40)
    else:
        solver, budget = pbng.MultigridPBNG(dtype=sys.argv[1], threads=threads), pbng.Budget(iterations=6)
    result = pbng.solve(scene, solver, budget)
    parts = (result.x, result.residuals, result.energies)
    parts += (np.array([result.force_scale, result.correction, result.error]),)
    digests.add(hashlib.sha256(b"".join(p.tobytes() for p in parts)).hexdigest())
    assert result.reduction < 0.5
print(len(scene.compile().X), *digests)
"""


@pytest.mark.parametrize("method", ["sweeps", "multigrid"])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_same_bits_for_one_and_two_threads(dtype, method):
    """A whole solve: positions, residuals, energies, error; None changes the number of threads on the way."""
    path = os.pathsep.join([str(Path(pbng.__file__).parents[1]), str(Path(__file__).parent)])
    env = {**os.environ, "NUMBA_NUM_THREADS": "2", "PYTHONPATH": path}
    out = subprocess.run(
        [sys.executable, "-c", THREADS, dtype, method], env=env, check=True, capture_output=True, text=True
    )
    n_vert, *digests = out.stdout.split()
    assert int(n_vert) == 4950
    assert len(digests) == 1


CACHED = """
import pbng
from conftest import twisted_bar
from models import SoftVolume
from pbng.jit import compile_seconds

for solver in (pbng.PBNG(dtype="auto"), pbng.MultigridPBNG()):
    pbng.solve(twisted_bar(SoftVolume(E=1e5, nu=0.3)), solver, pbng.Budget(rtol=1e-9, iterations=300))
print(compile_seconds())
"""


def test_a_second_process_compiles_nothing():
    """Every kernel is found in the cache, in both precisions, for a user's material too."""
    path = os.pathsep.join([str(Path(pbng.__file__).parents[1]), str(Path(__file__).parent)])
    env = {**os.environ, "PYTHONPATH": path}
    for _ in range(2):
        out = subprocess.run([sys.executable, "-c", CACHED], env=env, check=True, capture_output=True, text=True)
    assert float(out.stdout) == 0


def test_same_bits_when_run_again():
    """Nothing depends on what ran before: two problems made anew, and one method used twice."""
    states = []
    for _ in range(2):
        problem = held_box(pbng.Corotated(E=1e5, nu=0.3))
        method = pbng.PBNG(dtype="float64").set_up(problem)
        for _ in range(2):
            method.start(problem.X * [1.3, 0.8, 1.0])
            for _ in range(20):
                method.step()
            states.append(method.state().tobytes())
    assert len(set(states)) == 1


def test_renumbering_changes_nothing_but_rounding(rng):
    """The same mesh with vertices and cells in another order has the same equilibrium."""
    mesh = pbng.shapes.box((1.0, 0.7, 0.7), (4, 3, 3))
    order, cells = rng.permutation(mesh.n_vert), rng.permutation(mesh.n_elem)
    number = np.argsort(order)
    other = pbng.TetMesh(mesh.X[order], number[mesh.cells[cells]])
    found = []
    for m in (mesh, other):
        scene = pbng.Scene(gravity=(0, -9.8, 0))
        body = scene.add(m, pbng.Corotated(E=1e5, nu=0.3))
        scene.pin(body.where(x=0.0))
        found.append(pbng.solve(scene, pbng.PBNG(dtype="float64"), pbng.Budget(rtol=1e-12, iterations=500)).x)
    np.testing.assert_allclose(found[1], found[0][order], atol=1e-11)


@pytest.mark.parametrize(
    ("n", "vertices", "tets", "constraint_colors"),
    [(16, 4096, 16875, 39), (32, 32768, 148955, 38), (64, 262144, 1250235, 40)],
)
def test_table_1(n, vertices, tets, constraint_colors):
    """The paper's boxes have Table 1's vertices and tets, exactly 5 node colours, 39 constraint colours or one off."""
    mesh = pbng.shapes.box(vertices=n)
    assert (mesh.n_vert, mesh.n_elem) == (vertices, tets)
    start, incident = incidence(mesh.cells, mesh.n_vert)
    color = color_nodes(np.argsort(morton(mesh.X), kind="stable"), [(start, incident, 4, mesh.n_elem)])
    assert np.array_equal(np.unique(color), np.arange(5))
    assert is_valid(color, mesh.cells)
    color = color_constraints([mesh.cells], mesh.n_vert)
    assert color.max() + 1 == constraint_colors
    pairs = color.astype(np.int64)[:, None] * mesh.n_vert + mesh.cells
    assert np.bincount(pairs.ravel()).max() == 1  # no vertex in two constraints of one colour


def shared(problem, color):
    """Cells with two free vertices of one colour, by brute force."""
    bad = 0
    for group in problem.groups:
        c = np.sort(color[group.cells], axis=1)
        bad += np.count_nonzero(((c[:, 1:] == c[:, :-1]) & (c[:, 1:] >= 0)).any(1))
    return bad


@pytest.mark.parametrize("make", [mixed_problem, lambda: held_box(pbng.Corotated(E=1e5, nu=0.3), (6, 5, 4))])
def test_colourings_are_valid(make):
    """No element has two free vertices of one colour; prescribed ones have none; cells of several kinds too."""
    problem = make()
    color = problem.color
    assert shared(problem, color) == 0
    assert (color[problem.fixed] == -1).all()
    assert (color[~problem.fixed] >= 0).all()
    assert all(is_valid(color, g.cells) for g in problem.groups)


def test_invalid_colouring_is_seen():
    cells = np.array([[0, 1, 2, 3], [1, 2, 3, 4]], np.int32)
    assert is_valid(np.array([0, 1, 2, 3, 0], np.int32), cells)
    assert not is_valid(np.array([0, 1, 2, 3, 1], np.int32), cells)
    assert is_valid(np.array([0, -1, -1, 3, 0], np.int32), cells)


def test_too_many_colours_are_named():
    """A vertex that meets vertices of 64 colours cannot be coloured, and the message says which."""
    n = MAX_COLORS + 1
    pairs = np.array([(i, j) for i in range(n) for j in range(i)], np.int32)
    start, incident = incidence(pairs, n)
    with pytest.raises(pbng.InputError, match=f"vertex {n - 1} has neighbours of 64 colours"):
        color_nodes(np.arange(n), [(start, incident, 2, len(pairs))])


def test_morton_order_keeps_neighbours_together():
    """Consecutive vertices along the curve are close: the mean step is a few spacings."""
    X = pbng.shapes.box(vertices=16).X
    step = np.linalg.norm(np.diff(X[np.argsort(morton(X), kind="stable")], axis=0), axis=1)
    assert step.mean() < 2.0 / 15


def test_packed_layout_places_every_vertex_once(mixed):
    """Slots are distinct, free vertices in blocks of their colour, prescribed ones behind; pack and unpack invert."""
    packed = pack_problem(mixed, np.float64)
    assert len(np.unique(packed.slot)) == mixed.n_vert
    assert (packed.slot[mixed.fixed] >= 16 * packed.n_block).all()
    block = packed.slot[~mixed.fixed] // 16
    color = np.searchsorted(packed.color_start, block, side="right") - 1
    np.testing.assert_array_equal(color, mixed.color[~mixed.fixed])
    x = np.random.default_rng(0).standard_normal(mixed.X.shape)
    np.testing.assert_array_equal(packed.unpack(packed.pack(x)), x)
