"""Contact in the sweep: energy, forces, momentum, colours."""

import numba
import numpy as np
import pytest
import scipy.optimize

import pbng
from pbng.contact.contacts import ContactEnergy, Contacts
from pbng.contact.detection import Detector
from pbng.solvers.acceleration import NodeSOR

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
    """A problem, a state in which its blocks overlap and are crumpled, and the contacts there."""
    scene, lower = two_blocks(n, k_tau=k_tau, turn=0.3)
    scene.pin(lower.where(y=0))
    scene.collide_with(pbng.Plane((0, 0.05, 0), (0, 1, 0)))
    problem = scene.compile()
    rng = np.random.default_rng(seed)
    x = problem.X + 0.05 / n * rng.normal(size=problem.X.shape)
    upper = problem.bodies[1]
    x[upper.start : upper.stop, 1] -= squeeze
    x = problem.constrain(x, 0)
    contacts = Detector(problem.contact, problem.X, problem.fixed).find(x, x, 0, 0)
    assert len(contacts.vertices) > 20
    return problem, x, contacts


@pytest.mark.parametrize("k_tau", [0.0, 30.0])
def test_forces_are_the_slope_of_the_energy(k_tau):
    problem, x, contacts = in_contact(k_tau=k_tau)
    energy = ContactEnergy(contacts, problem.n_vert, np.arange(problem.n_vert), np.zeros(3))
    assert energy.energy(x) > 0
    f, _ = energy.forces(x)
    rng = np.random.default_rng(1)
    for _ in range(5):
        d = rng.normal(size=x.shape)
        slope = (energy.energy(x + 1e-6 * d) - energy.energy(x - 1e-6 * d)) / 2e-6
        assert slope == pytest.approx(-(f * d).sum(), rel=1e-5)
    assert np.abs(f.sum(0)).max() < 1e-9 * np.abs(f).max()


@pytest.mark.parametrize("omega", [1.0, 1.5, 1.9])
@pytest.mark.parametrize("seed", range(3))
def test_energy_never_rises_with_contacts(omega, seed):
    problem, x, contacts = in_contact(seed, squeeze=0.1 * seed, k_tau=20.0 * seed)
    method = pbng.PBNG(NodeSOR(omega), dtype="float64").set_up(problem)
    method.start(contacts.put_outside(x), contacts=contacts)
    energies = [method.energy(method.x)]
    for _ in range(20):
        method.step()
        energies.append(method.energy(method.x))
    assert method.touching.energy(method.x.reshape(-1, 4)[:, :3]) > 0
    assert np.all(np.diff(energies) <= 1e-12 * abs(energies[0]))
    assert energies[-1] < energies[0]


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


@pytest.mark.parametrize("friction", [0.0, 0.2, 0.5])
def test_a_block_slides_down_a_slope_as_coulomb_says(friction):
    slope = np.deg2rad(20)
    scene = pbng.Scene(gravity=(9.8 * np.sin(slope), -9.8 * np.cos(slope), 0))
    scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 4), pbng.Corotated(E=1e5, nu=0.3, density=100.0))
    scene.collide_with(pbng.Plane((0, 0, 0), (0, 1, 0), friction=friction))
    frames = list(pbng.simulate(scene, pbng.PBNG(), pbng.Budget(rtol=1e-4), frames=41, inertia=True))
    speed = (frames[-1].momentum[0] - frames[-16].momentum[0]) / 100.0
    wanted = max(9.8 * (np.sin(slope) - friction * np.cos(slope)), 0.0) * 0.5
    assert speed == pytest.approx(wanted, abs=0.05 * 9.8 * 0.5)


def test_what_starts_inside_comes_out():
    scene, lower = two_blocks(4, gap=-0.2)
    scene.pin(lower.where(y=0))
    frames = list(pbng.simulate(scene, pbng.PBNG(), pbng.Budget(iterations=20), frames=30, inertia=True, substeps=2))
    depth = [f.contact.deepest for f in frames]
    assert depth[0] > 0.1
    assert depth[-1] < 0.02
    assert frames[-1].result.inverted == 0
    assert np.abs(frames[-1].v).max() < 2.0


def test_a_thickness_that_leaves_rest_no_room_is_refused():
    def sheet(thickness, rings):
        scene = pbng.Scene()
        cloth = scene.add(pbng.shapes.sheet((1.0, 1.0), 11), pbng.Membrane(E=1.0, nu=0.3), name="sheet")
        scene.pin(cloth.where(x=0))
        scene.contact(self_collision=True, thickness=thickness, rings=rings)
        problem = scene.compile()
        return Detector(problem.contact, problem.X, problem.fixed).find(problem.X, problem.X, 0, 0)

    assert (sheet(0.06, 1).clearance(pbng.shapes.sheet((1.0, 1.0), 11).X) > 0).all()
    sheet(0.1, 2)
    with pytest.raises(pbng.InputError, match=r"'sheet' keeps 0.1 m from itself.* is 0.07071 m from a triangle"):
        sheet(0.1, 1)


def test_a_body_that_starts_inside_another_is_refused():
    scene = pbng.Scene()
    scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 4), SOFT, name="out")
    scene.add(pbng.shapes.box((0.2, 0.2, 0.2), 3), SOFT, name="in", at=(0.4, 0.4, 0.4))
    scene.contact()
    with pytest.raises(pbng.InputError, match="'in' starts fully inside body 'out'"):
        next(pbng.simulate(scene, frames=1, inertia=True))


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


@pytest.mark.parametrize(
    ("rule", "said"),
    [
        ({"k_n": 0.0}, "k_n must be positive and finite"),
        ({"radius": -1.0}, "radius must be positive and finite"),
        ({"k_tau": -1.0}, "k_tau must be finite and not negative"),
        ({"rings": 0}, "rings must be a whole number"),
    ],
)
def test_bad_rules(rule, said):
    with pytest.raises(pbng.InputError, match=said):
        two_blocks(3, **rule)


def test_a_plane_body_has_no_surface():
    scene = pbng.Scene()
    flat = scene.add(pbng.shapes.rectangle((1.0, 1.0), 4), SOFT, name="flat")
    with pytest.raises(pbng.InputError, match="'flat' has no surface"):
        scene.contact(self_collision=[flat])
    scene.contact(self_collision=True)
    with pytest.raises(pbng.InputError, match="'flat' has no surface"):
        scene.compile(free=True)
    with pytest.raises(pbng.InputError, match="called twice"):
        scene.contact()


def test_only_colliders_collide():
    with pytest.raises(pbng.InputError, match="expected a collider such as Plane"):
        pbng.Scene().collide_with([pbng.Plane((0, 0, 0), (0, 1, 0)), 3])


def test_other_methods_say_that_they_know_no_contact():
    scene, _ = two_blocks(3)
    problem = scene.compile(free=True)
    for solver in (pbng.Newton(), pbng.XPBD(), pbng.PBD()):
        with pytest.raises(pbng.InputError, match="knows nothing of contact"):
            solver.set_up(problem)
