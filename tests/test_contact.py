"""Contact in the sweep: energy, forces, Hessian, momentum, colours."""

from dataclasses import replace
from itertools import pairwise

import numba
import numpy as np
import pytest
import scipy.optimize
import scipy.sparse

import pbng
from pbng.contact.contacts import ContactEnergy, Contacts
from pbng.contact.detection import Detector
from pbng.contact.nodes import HELD
from pbng.elements.base import W
from pbng.packing import NODAL
from pbng.solvers.acceleration import NodeSOR
from pbng.solvers.loop import run

SOFT = pbng.Corotated(E=1e3, nu=0.3, density=10.0)


def two_blocks(n=5, gap=0.02, turn=0.0, **rule):
    """Two cubes of 1 m, one above the other and a little shifted."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    lower = scene.add(pbng.shapes.box((1.0, 1.0, 1.0), n), SOFT, name="lower")
    mesh = pbng.shapes.box((1.0, 1.0, 1.0), n)
    c, s = np.cos(turn), np.sin(turn)
    X = (mesh.X - 0.5) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + 0.5
    scene.add(pbng.TetMesh(X, mesh.cells), SOFT, name="upper", at=(0.13, 1.0 + gap, 0.07))
    scene.contact(**rule)
    return scene, lower


def in_contact(seed=0, squeeze=0.1, k_tau=0.0, n=4):
    """A problem, a state in which its blocks overlap and are crumpled, and the contacts there.

    Twenty vertices, of which ten are in no other contact, have one to four half-spaces each, in all directions, with
    friction, and have slid by some centimetres.
    """
    scene, lower = two_blocks(n, k_tau=k_tau, turn=0.3)
    scene.pin(lower.where(y=0))
    problem = scene.compile()
    rng = np.random.default_rng(seed)
    x = problem.X + 0.05 / n * rng.normal(size=problem.X.shape)
    upper = problem.bodies[1]
    x[upper.start : upper.stop, 1] -= squeeze
    x = problem.constrain(x, 0)
    contacts = Detector(problem.contact, problem.X, problem.fixed).find(x, x, 0, 0)
    assert len(contacts.vertices) > 20
    free = problem.contact.surface[~problem.fixed[problem.contact.surface]]
    parts = [free[np.isin(free, contacts.vertices, invert=i)] for i in (False, True)]
    vertex = np.concatenate([rng.choice(part, 10, replace=False) for part in parts])
    vertex = np.repeat(vertex, 1 + np.arange(20) % 4).astype(np.int32)
    plane = rng.normal(size=(len(vertex), 3))
    plane /= np.linalg.norm(plane, axis=1)[:, None]
    contacts = replace(
        contacts,
        vertex=vertex,
        plane=plane,
        level=(plane * x[vertex]).sum(1) - 0.02 * np.abs(rng.normal(size=len(vertex))),
        friction=5.0 * rng.random(len(vertex)),
        anchor=x[vertex] + 0.02 * rng.normal(size=plane.shape),
        creep=1e-3,
    )
    return problem, x, contacts


def energy_of(contacts, problem):
    """Energy of contacts in the problem's numbering."""
    return ContactEnergy(contacts, problem.n_vert, np.arange(problem.n_vert), np.zeros(3))


@pytest.mark.parametrize("k_tau", [0.0, 30.0])
def test_forces_are_the_slope_of_the_energy(k_tau):
    problem, x, contacts = in_contact(k_tau=k_tau)
    energy = energy_of(contacts, problem)
    assert energy.energy(x) > 0
    f, _ = energy.forces(x)
    rng = np.random.default_rng(1)
    for _ in range(5):
        d = rng.normal(size=x.shape)
        slope = (energy.energy(x + 1e-6 * d) - energy.energy(x - 1e-6 * d)) / 2e-6
        assert slope == pytest.approx(-(f * d).sum(), rel=1e-5)
    between = energy_of(replace(contacts, friction=0 * contacts.friction), problem).forces(x)[0]
    assert np.abs(between.sum(0)).max() < 1e-9 * np.abs(between).max()


def test_the_hessian_is_the_slope_of_the_forces():
    """Contacts that resist or did, and friction where nothing has slid yet; touched half-spaces are springs."""
    problem, x, contacts = in_contact(k_tau=30.0)
    x[problem.bodies[1].start :, 1] += 0.05
    contacts = replace(contacts, anchor=x[contacts.vertex])
    energy, n = energy_of(contacts, problem), problem.n_vert
    active = energy.active(x, 0.01)
    resists, held = np.split(active, [len(contacts.vertices)])
    sticks = contacts.k_tau > 0
    assert all(some.any() for some in (resists, sticks & ~resists, ~sticks, held, ~held))
    bearing = np.random.default_rng(1).uniform(1e6, 2e6, n)  # more than friction is stiff
    H = energy.hessian(x, active, bearing, scipy.sparse.identity(n, format="csr"))
    assert abs(H - H.T).max() < 1e-9 * abs(H).max()
    touched = energy_of(replace(contacts, friction=contacts.friction * held), problem)
    rng = np.random.default_rng(2)
    for _ in range(5):
        d = rng.normal(size=x.shape)
        slope = (touched.forces(x - 1e-7 * d)[0] - touched.forces(x + 1e-7 * d)[0]) / 2e-7
        v, p = contacts.vertex[held], contacts.plane[held]
        np.add.at(slope, v, (bearing[v] * (p * d[v]).sum(1))[:, None] * p)
        assert np.abs(H @ d.ravel() - slope.ravel()).max() < 1e-5 * np.abs(slope).max()
    k = n - 7  # of the first k positions, interpolated
    U = scipy.sparse.random(k, 12, density=0.3, format="csr", rng=3)
    coarse = energy.hessian(x, active, bearing, U)
    lifted = scipy.sparse.kron(U, np.eye(3)).tocsr()
    wanted = lifted.T @ H.tocsr()[: 3 * k, : 3 * k] @ lifted
    assert abs(coarse - wanted).max() < 1e-12 * abs(wanted).max()
    # Friction that is stiffer than the half-space counts as stiff as that.
    soft = energy.hessian(x, active, np.full(n, 1.0), scipy.sparse.identity(n, format="csr"))
    alone = np.setdiff1d(contacts.vertex[held], contacts.vertices)
    for v in alone:
        block = soft.tocsr()[3 * v : 3 * v + 3, 3 * v : 3 * v + 3].toarray()
        np.testing.assert_allclose(block, np.sum(contacts.vertex[held] == v) * np.eye(3), atol=1e-12)


def test_closing_forces_are_at_rest_where_gaps_are_closed():
    """Of one contact and one half-space that are open: the springs of the Hessian take them to a gap of zero."""
    problem, x, contacts = in_contact()
    energy, n, m = energy_of(contacts, problem), problem.n_vert, len(contacts.vertices)
    bearing = np.random.default_rng(1).uniform(1e3, 2e3, n)
    gap = contacts.clearance(x)
    contact, wall = int(gap.argmax()), int(np.argmax(~np.isin(contacts.vertex, contacts.vertices)))
    assert gap[contact] > 0
    free = energy_of(replace(contacts, friction=0 * contacts.friction), problem)
    for k in (contact, m + wall):
        active = np.arange(m + len(contacts.vertex)) == k
        d = np.zeros_like(x)
        if k < m:
            w = contacts.weights[k]
            d[contacts.vertices[k]] = -gap[k] / (w @ w) * w[:, None] * contacts.normal[k]
            assert replace(contacts, kept=contacts.offset).clearance(x + d)[k] == pytest.approx(0, abs=1e-12)
        else:
            v, p = contacts.vertex[wall], contacts.plane[wall]
            d[v] = (contacts.level[wall] - p @ x[v]) * p
            assert p @ d[v] < 0
        H = free.hessian(x, active, bearing, scipy.sparse.identity(n, format="csr"))
        f = free.closing(x, active, bearing)
        assert np.abs(f).max() > 0
        np.testing.assert_allclose((H @ d.ravel()).reshape(-1, 3), f, atol=1e-9 * np.abs(f).max())
    nowhere = replace(contacts, plane=0 * contacts.plane, level=np.full(len(contacts.level), -np.inf))
    assert np.isfinite(energy_of(nowhere, problem).closing(x, np.arange(len(active)) < m, bearing)).all()
    closed = np.concatenate([gap < 0, np.zeros(len(contacts.vertex), bool)])
    assert closed.any()
    assert (energy.closing(x, closed, bearing) == 0).all()


@pytest.mark.parametrize(
    ("solver", "most"),
    [(pbng.PBNG(NodeSOR(1.5), dtype="float64"), 1000), (pbng.PBNG(dtype="float64"), 150),
     (pbng.PBNG(dtype="float64", symmetric=True), 100), (pbng.MultigridPBNG(dtype="float64"), 40)],
)  # fmt: skip
@pytest.mark.parametrize("seed", range(4))
def test_solves_come_to_rest_where_forces_do(seed, solver, most):
    """Contacts, what sticks and rubs, and corners of several half-spaces: kernel and certificate mean the same."""
    problem, x, contacts = in_contact(seed, k_tau=30.0)
    method = solver.set_up(problem)
    result = run(method, contacts.put_outside(x), pbng.Budget(rtol=1e-8, iterations=most), contacts=contacts)
    assert result.status is pbng.Status.CONVERGED
    height = (contacts.plane * result.x[contacts.vertex]).sum(1) - contacts.level
    assert height.min() > -1e-9
    assert (height < 1e-9).sum() > 5


@pytest.mark.parametrize("omega", [1.0, 1.5, 1.9])
@pytest.mark.parametrize("seed", range(3))
def test_energy_never_rises_with_contacts(omega, seed):
    problem, x, contacts = in_contact(seed, squeeze=0.1 * seed, k_tau=20.0 * seed)
    method = pbng.PBNG(NodeSOR(omega), dtype="float64").set_up(problem)
    method.start(contacts.put_outside(x), contacts=contacts)
    energies = [method.energy(method.x)]
    _, at, count = np.unique(contacts.vertex, return_inverse=True, return_counts=True)
    single = (count[at] == 1) & ~np.isin(contacts.vertex, contacts.vertices)  # these hold at once
    assert single.sum() > 1
    for _ in range(20):
        method.step()
        energies.append(method.energy(method.x))
        height = (contacts.plane * method.state()[contacts.vertex]).sum(1) - contacts.level
        assert height[single].min() > -1e-12
    assert method.touching.energy(method.x.reshape(-1, 4)[:, :3]) > 0
    assert np.all(np.diff(energies) <= 1e-12 * abs(energies[0]))
    assert energies[-1] < energies[0]
    assert height.min() > -1e-3
    assert (height < 1e-6).sum() > 5


def test_a_node_moves_to_the_minimum_of_what_it_sees():
    """One colour, one sweep: no node can lower the energy further by itself (Neo-Hookean: its block is exact)."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    rubber = pbng.NeoHookean(E=1e3, nu=0.3, density=10.0)
    scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 3), rubber, name="lower")
    scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 3), rubber, name="upper", at=(0.13, 0.96, 0.07))
    scene.contact()
    scene.collide_with(pbng.Plane((0, 0.02, 0), (0, 1, 0)))
    problem = scene.compile(free=True)
    x = problem.X + 0.01 * np.random.default_rng(0).normal(size=problem.X.shape)
    contacts = Detector(problem.contact, problem.X, problem.fixed).find(x, x, 0, 0)
    method = pbng.PBNG(NodeSOR(1.0), dtype="float64").set_up(problem)
    method.start(contacts.put_outside(x), contacts=contacts)
    method.step()
    nodes = method.contact_nodes["float64"]
    last = nodes.node[nodes.color[nodes.node] == nodes.color[nodes.node].max()]
    x = method.state()
    energy = ContactEnergy(contacts, problem.n_vert, np.arange(problem.n_vert), np.zeros(3))

    def total(x):
        return problem.energy(x) + energy.energy(x)

    for v in last:
        walls = contacts.plane[contacts.vertex == v]

        def moved(d, v=v):
            y = x.copy()
            y[v] += d
            return total(y)

        bound = [{"type": "ineq", "fun": lambda d, n=n, l=l, v=v: n @ (x[v] + d) - l} for n, l in
                 zip(walls, contacts.level[contacts.vertex == v])]  # fmt: skip
        best = scipy.optimize.minimize(moved, np.zeros(3), constraints=bound, method="SLSQP", tol=1e-14)
        assert total(x) - best.fun < 1e-9 * abs(best.fun)


def test_colors_are_valid_and_kept():
    problem, x, contacts = in_contact(n=5)
    method = pbng.PBNG(dtype="float64").set_up(problem)
    method.start(contacts.put_outside(x), contacts=contacts)
    method.step()
    nodes = method.contact_nodes["float64"]
    found = np.union1d(contacts.vertices, contacts.vertex)
    assert np.array_equal(nodes.node, found[~problem.fixed[found]])
    among = np.zeros(problem.n_vert, bool)
    among[nodes.node] = True
    color = np.where(among, nodes.color, -1)
    for cells in [*(g.cells for g in problem.groups), contacts.vertices]:
        assert pbng.coloring.is_valid(color, cells)
    changed = (nodes.color[nodes.node] != problem.color[nodes.node]).sum()
    assert changed == nodes.recolored
    assert 0 < changed < len(nodes.node)
    before, repacked = nodes.color.copy(), nodes.repacked
    method.start(contacts.put_outside(x), contacts=Contacts(**vars(contacts)))
    assert np.array_equal(before, nodes.color)
    assert nodes.repacked == repacked


def test_layouts_that_grow_are_as_good_as_new(monkeypatch):
    """Contacts come and go: each node in contact moves in one lane, all others in none, and sweeps come to rest."""
    problem, x, contacts = in_contact(n=5)
    method = pbng.PBNG(dtype="float64").set_up(problem)
    monkeypatch.setattr("pbng.contact.nodes.ROOM", 2.0)  # a small scene has few blocks
    rng, grown, blocks, before = np.random.default_rng(0), 0, None, 0
    among = rng.random(len(contacts.vertices)) < 0.6
    for _ in range(12):
        among ^= rng.random(len(among)) < 0.03
        some = {
            name: getattr(contacts, name)[among]
            for name in ("vertices", "weights", "normal", "offset", "k_n", "k_tau", "start", "kept")
        }
        found = replace(contacts, **some)
        method.start(found.put_outside(x), contacts=found)
        method.step()
        nodes = method.contact_nodes["float64"]
        grown += blocks is nodes.blocks and before < len(nodes.owner)
        blocks, before = nodes.blocks, len(nodes.owner)
        assert (nodes.lane >= 0).sum() > len(nodes.node)  # neighbours have the lanes left over
        assert (np.diff(blocks.color_start) > 0).all()
        moving = nodes.owner[nodes.place >= 0]
        assert np.array_equal(np.sort(moving), nodes.node)
        assert np.array_equal(nodes.place[nodes.place >= 0], 4 * method.packed.slot[moving])
        for first, last in pairwise(nodes.blocks.color_start):
            lanes = slice(W * first, W * last)
            assert len(np.unique(nodes.color[nodes.owner[lanes][nodes.place[lanes] >= 0]])) <= 1
        held = nodes.others.nodal.reshape(-1, NODAL, W)[:, 3].ravel() == HELD
        assert np.array_equal(np.flatnonzero(held), np.sort(method.packed.slot[nodes.node]))
    assert grown >= 3
    first = method.certify().residual
    for _ in range(300):
        method.step()
    assert method.certify().residual < 1e-9 * first


def test_what_is_not_a_number_passes():
    problem, x, contacts = in_contact()
    method = pbng.PBNG(dtype="float64").set_up(problem)
    method.start(contacts.put_outside(x), contacts=contacts)
    good, bad, again = method.x.copy(), method.x * 1e300, method.x.copy()
    method.apply(bad)
    assert not np.isfinite(bad).all()
    method.apply(again)
    for v in method.contact_nodes.values():
        v.force[:] = 0
    method.apply(good)
    np.testing.assert_array_equal(again, good)


def test_a_node_that_meets_many_colors_gets_a_free_one():
    """More than there are bits in a word: 0 to 63 around it, and 64 in a contact."""
    n = 66
    color = np.append(np.arange(65), 5).astype(np.int32)
    start = np.append(np.zeros(n), 64).astype(np.int64)
    stencils = np.array([[65, 64, 0, 1]], np.int32)
    pbng.coloring.recolor(np.array([65]), color, start, np.arange(64), stencils, np.ones(n, bool))
    assert color.tolist() == [*range(65), 65]


def test_contact_between_free_bodies_keeps_momentum():
    """Two blocks fly into each other, and apart; each step converged."""
    scene, _ = two_blocks(4, gap=0.05)
    scene.gravity = (0.0, 0.0, 0.0)
    problem = scene.compile(free=True)
    velocity = np.zeros_like(problem.X)
    velocity[problem.bodies[1].start :] = (0.3, -2.0, 0.1)
    frames = list(
        pbng.simulate(
            problem, pbng.PBNG(dtype="float64"), pbng.Budget(rtol=1e-12, iterations=2000), frames=12, fps=60,
            inertia=True, velocity=velocity,
        )
    )  # fmt: skip
    assert max(f.contact.pairs for f in frames) > 10
    momentum = np.array([f.momentum for f in frames])
    assert np.abs(momentum - momentum[0]).max() < 1e-8 * np.abs(momentum[0]).max()
    angular = np.array([f.angular_momentum for f in frames])
    turn = np.abs(angular - angular[0]).max() / np.abs(angular[0]).max()
    assert turn < 0.05  # backward Euler itself is not exact here
    lower = problem.bodies[0].stop
    assert (problem.mass[:lower] @ frames[-1].v[:lower])[1] < -1.0


def test_stacked_blocks_come_to_rest_and_bear_their_weight():
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    rubber = pbng.Corotated(E=1e5, nu=0.3, density=100.0)
    for k in range(3):
        scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 4), rubber, name=f"block{k}", at=(0.03 * k, 1.02 * k, 0.02 * k))
    scene.contact(k_tau=1e5)
    scene.collide_with(pbng.Plane((0, 0, 0), (0, 1, 0), friction=0.5))
    problem = scene.compile(free=True)
    *_, frame = pbng.simulate(problem, pbng.PBNG(), pbng.Budget(rtol=1e-4), frames=60, inertia=True)
    assert frame.kinetic_energy < 0.01 * 300 * 9.8 * 0.1  # of a fall by a tenth
    assert frame.result.inverted == 0
    assert frame.contact.deepest < 0.05
    x = np.asarray(frame.x, float)
    contacts = Detector(problem.contact, problem.X, problem.fixed).find(x, x, 0, 0)
    f, _ = ContactEnergy(contacts, problem.n_vert, np.arange(problem.n_vert), np.zeros(3)).forces(x)
    upper = slice(problem.bodies[2].start, None)
    assert f[upper, 1].sum() == pytest.approx(100.0 * 9.8, rel=0.02)


def test_what_starts_inside_comes_out():
    scene, lower = two_blocks(4, gap=-0.2)
    scene.pin(lower.where(y=0))
    frames = list(pbng.simulate(scene, pbng.PBNG(), pbng.Budget(iterations=20), frames=30, inertia=True, substeps=2))
    depth = [f.contact.deepest for f in frames]
    assert depth[0] > 0.1
    assert depth[-1] < 0.02
    assert frames[-1].result.inverted == 0
    assert np.abs(frames[-1].v).max() < 2.0


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_same_bits_for_any_number_of_threads(dtype):
    def last(threads):
        scene, lower = two_blocks(5, gap=0.0, turn=0.2)
        scene.pin(lower.where(y=0))
        solver = pbng.PBNG(dtype=dtype, threads=threads)
        *_, frame = pbng.simulate(scene, solver, pbng.Budget(iterations=15), frames=6, inertia=True, substeps=2)
        return frame

    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one thread only")
    one, two = last(1), last(2)
    assert one.contact.pairs > 0
    assert np.array_equal(one.x, two.x)
    assert np.array_equal(one.v, two.v)
