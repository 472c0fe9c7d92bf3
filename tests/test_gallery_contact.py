"""Scenes of the gallery in which things touch, or are cloth: each runs, tiny, and what its words promise is so."""

from functools import cache

import numpy as np
import pytest

import pbng
from pbng.gallery import contact, falling, find, solids

BODY = pbng.shapes.beam(1.0, 0.4, 3)
# Options; frames that are run a second time, past the first contacts; and how long an edge may be at any time, over its
# length at rest: as measured, and a little more. The cloth of Fig. 19 is heavy beside its stiffness.
RUNS = {
    "two_blocks_colliding": ({"resolution": 4}, 16, 1.3),
    "squeezed_ball": ({"resolution": 6}, 14, 1.5),
    "dropping_shapes": ({"resolution": 4, "shapes": 6}, 12, 1.5),
    "armadillos": ({"surface": BODY, "bodies": 2, "cloth": 12, "free_at": 0.7}, 18, 1.7),
    "cloth_on_sphere": ({"resolution": 14}, 14, 1.1),
    "hanging_cloth": ({"resolution": 6}, 4, 3.0),
    "twisted_cloth": ({"resolution": 8}, 40, 1.3),
}
FALLING = "dropping_shapes", "armadillos", "cloth_on_sphere", "hanging_cloth"
DRIVEN = "two_blocks_colliding", "twisted_cloth"
SOLID = "two_blocks_colliding", "squeezed_ball", "dropping_shapes", "armadillos"
TOUCHING = [name for name in RUNS if name != "hanging_cloth"]


def made(name):
    return find(name)(**RUNS[name][0])


@cache
def frames(name, again=False):
    recipe = made(name)
    motion = {"inertia": recipe.inertia, "dt": recipe.dt, "substeps": recipe.substeps}
    n = RUNS[name][1] if again else recipe.frames
    return list(pbng.simulate(recipe.scene, recipe.solver, recipe.budget, frames=n, fps=recipe.fps, **motion))


def body(name, k):
    """Positions (frames, n, 3) of body k."""
    part = frames(name)[0].problem.bodies[k]
    return np.array([f.x[part.start : part.stop] for f in frames(name)])


def thickness(name):
    return 2 * frames(name)[0].problem.contact.surfaces.skin[0]


def longest(name):
    """The longest edge of any body in each frame, over its length at rest, (frames,)."""
    ratios = []
    for k, part in enumerate(frames(name)[0].problem.bodies):
        i, j = part.mesh.edges.T
        length = np.linalg.norm(body(name, k)[:, i] - body(name, k)[:, j], axis=2)
        ratios.append((length / np.linalg.norm(part.mesh.X[i] - part.mesh.X[j], axis=1)).max(1))
    return np.max(ratios, axis=0)


@pytest.mark.parametrize("name", RUNS)
def test_runs_to_the_end(name):
    """All frames come, which they do not where a state is lost; nothing is overstretched, and something happens."""
    run, recipe = frames(name), made(name)
    assert [f.index for f in run] == list(range(recipe.frames))
    assert run[-1].t == pytest.approx((recipe.frames - 1) / recipe.fps)
    assert all(f.result.status.ok for f in run)
    assert recipe.scene.name == name
    assert longest(name).max() < RUNS[name][2]
    assert max(np.abs(f.x - run[0].x).max() for f in run) > 0.15 * np.ptp(run[0].x, axis=0).max()


@pytest.mark.parametrize("name", SOLID)
def test_no_tet_stays_inverted(name):
    run = frames(name)
    tets = sum(len(g.cells) for g in run[0].problem.groups if g.kind.name == "tet")
    assert run[-1].result.inverted == 0
    assert max(f.result.inverted for f in run) <= 0.01 * tets


@pytest.mark.parametrize("name", DRIVEN)
def test_what_is_driven_is_not_thrown_and_comes_to_rest(name):
    """Its kinetic energy is at most twice what it would be if all of it moved as fast as what is driven ever does."""
    run = frames(name)
    problem, kinetic = run[0].problem, np.array([f.kinetic_energy for f in run])
    fastest = max(np.linalg.norm(f.v[problem.fixed], axis=1).max() for f in run)
    assert kinetic.max() < 2 * 0.5 * problem.mass.sum() * fastest**2
    assert kinetic[-1] < 0.2 * kinetic.max()


@pytest.mark.parametrize("name", RUNS)
def test_the_same_bits_twice(name):
    again = frames(name, again=True)
    for one, two in zip(frames(name), again):
        assert np.array_equal(one.x, two.x)
        assert one.v is None or np.array_equal(one.v, two.v)
    touch = again[-1].contact
    assert name == "hanging_cloth" or touch.pairs + touch.walls > 0


@pytest.mark.parametrize("name", FALLING)
def test_energy_does_not_rise_where_only_gravity_works(name):
    total = np.array([f.kinetic_energy + f.potential_energy for f in frames(name)])
    gained = total - np.minimum.accumulate(total)
    assert gained.max() < 0.02 * max(f.kinetic_energy for f in frames(name))


@pytest.mark.parametrize("name", TOUCHING)
def test_penetration_is_shallow(name):
    surfaces = frames(name)[0].problem.contact.surfaces
    if surfaces is not None:
        deepest = max(f.contact.deepest for f in frames(name))
        assert deepest < 0.15 * surfaces.spacing.max()
        assert max(f.contact.pairs for f in frames(name)) > 3
    for f in frames(name):
        for c in f.problem.contact.colliders:
            inside = c.distance(f.x[f.problem.contact.surface], f.t)[0].min()
            assert inside > c.thickness - 0.1 * (c.thickness or 0.01)


def test_blocks_meet_are_squeezed_and_part():
    pairs = np.array([f.contact.pairs for f in frames("two_blocks_colliding")])
    assert pairs[0] == pairs[-1] == 0
    left, right = body("two_blocks_colliding", 0), body("two_blocks_colliding", 1)
    middle = round(30 * (contact.IN + 0.5 * contact.HELD))
    assert pairs[middle] > 10
    near = np.isclose(left[0, :, 0], -contact.GAP / 2)  # it would go as far as the held face, if nothing were there
    assert left[middle, near, 0].mean() < -contact.GAP / 2 + 0.6 * contact.DRIVE
    assert right[-1, :, 0].min() > left[-1, :, 0].max()
    stiffer = find("two_blocks_colliding")(resolution=3, k_n=123.0).scene.compile()
    assert stiffer.contact.surfaces.k_n == 123.0


def test_ball_is_squeezed_and_becomes_round_again():
    x = body("squeezed_ball", 0)
    height = np.ptp(x[:, :, 1], axis=1)
    assert height[30] == pytest.approx(2 * contact.RADIUS * (1 - contact.SQUEEZE), rel=1e-3)
    assert np.ptp(x[30, :, 0]) > 1.05 * 2 * contact.RADIUS
    assert height[-1] == pytest.approx(height[0], rel=0.01)
    assert height[-1] > 0.9 * 2 * contact.RADIUS
    assert {f.result.status for f in frames("squeezed_ball")} == {pbng.Status.CONVERGED}


def test_shapes_are_of_five_kinds_apart_and_end_in_the_box():
    recipe = made("dropping_shapes")
    bodies = recipe.scene.bodies
    assert {b.name.split()[0] for b in bodies} == {"brick", "ball", "ring", "plank", "rod"}
    centres = np.array([b.mesh.X.mean(0) for b in bodies])
    radii = np.array([np.linalg.norm(b.mesh.X - c, axis=1).max() for b, c in zip(bodies, centres)])
    apart = np.linalg.norm(centres[:, None] - centres, axis=2) + 9 * np.eye(len(bodies))
    assert (apart > radii[:, None] + radii).all()
    assert not np.allclose(bodies[0].mesh.X - centres[0], bodies[5].mesh.X - centres[5])  # another brick, turned
    last = frames("dropping_shapes")[-1]
    assert last.x[:, 1].min() > -1e-6
    speed = np.linalg.norm(last.v, axis=1).mean()
    assert speed < 0.7 * max(np.linalg.norm(f.v, axis=1).mean() for f in frames("dropping_shapes"))


@pytest.mark.parametrize("make", falling.SHAPES)
@pytest.mark.parametrize("n", [4, 7, 12])
def test_solids_are_sound(make, n):
    mesh = make(n)
    assert (mesh.volume > 0).all()
    assert 0.7 * n**3 < mesh.n_vert < 1.5 * n**3 or n == 4
    assert np.abs(mesh.X.mean(0)).max() < 1e-3
    assert len(np.unique(mesh.cells)) == mesh.n_vert
    edges = {tuple(e) for f in mesh.surface for e in np.sort(np.stack([f, np.roll(f, 1)], 1), axis=1)}
    handles = 2 - (len(np.unique(mesh.surface)) - len(edges) + len(mesh.surface))
    assert handles == (2 if make is solids.ring else 0)


def test_paper_size_of_the_shapes():
    counts = [(m.n_vert, m.n_elem) for m in (make(19) for make in falling.SHAPES)]
    assert 8 * np.sum(counts, axis=0) == pytest.approx([256e3, 1069e3], rel=0.08)


def test_bodies_are_held_by_the_cloth_until_it_gives_way():
    run = frames("armadillos")
    cloth, X = body("armadillos", 0), run[0].problem.X
    part = run[0].problem.bodies[0]
    held = np.flatnonzero(run[0].problem.fixed[part.start : part.stop])
    assert len(held) == 4
    freed = held[X[held, 0] > 0]
    assert len(freed) == 2
    before, after = 20, -1  # at 0.67 s, and at the end
    assert np.abs(cloth[before, held] - X[held]).max() < 1e-9
    assert (cloth[after, freed, 1] < -1.0).all()
    assert np.abs(cloth[after, np.setdiff1d(held, freed)] - X[np.setdiff1d(held, freed)]).max() < 1e-9
    assert sum(f.contact.pairs > 0 for f in run) > 5
    for k in (1, 2):
        assert body("armadillos", k)[before, :, 1].mean() > cloth[before, :, 1].min()


def test_armadillos_are_little_dragons_or_from_a_file(tmp_path):
    dragon = find("armadillos")(resolution=10, bodies=1, cloth=6).scene.bodies[1].mesh
    assert dragon.skin is not None
    assert np.ptp(dragon.X, axis=0).max() > 0.9
    mesh = pbng.shapes.box((2.0, 1.0, 1.0), 4)
    scene = find("armadillos")(surface=mesh, bodies=6, cloth=8).scene
    assert len(scene.bodies) == 7
    assert scene.bodies[1].mesh.n_vert == 64
    volume = scene.bodies[1].mesh.volume.sum()
    assert volume == pytest.approx(0.25)  # a length of 1 m
    file = tmp_path / "nothing.obj"
    with pytest.raises(pbng.InputError, match=r"nothing\.obj"):
        find("armadillos")(surface=file)


def test_cloth_stays_out_of_the_ball_and_comes_to_rest():
    run = frames("cloth_on_sphere")
    ball = run[0].problem.contact.colliders[0]
    for f in run:
        assert ball.distance(f.x)[0].min() > ball.thickness - 0.1 * ball.thickness
        assert f.contact.deepest < 0.1 * thickness("cloth_on_sphere")
    last = run[-1]
    assert last.kinetic_energy < 0.01 * max(f.kinetic_energy for f in run)
    assert last.x[:, 1].min() < -0.3  # the corners hang down
    assert last.x[:, 1].max() > 0.0  # and it has not slipped off
    assert last.contact.walls > 20


def test_cloth_hangs_by_two_corners():
    run = frames("hanging_cloth")
    problem = run[0].problem
    assert problem.fixed.sum() == 2
    assert all(np.array_equal(f.x[problem.fixed], problem.X[problem.fixed]) for f in run)
    assert min(f.x[:, 1].min() for f in run) < -1.0
    assert not any(g.kind.name == "hinge" for g in problem.groups)
    bent = find("hanging_cloth")(resolution=6, k_bend=0.1).scene.compile()
    assert len(bent.groups) == len(problem.groups) + 1


def test_strip_is_twisted_and_touches_itself():
    run = frames("twisted_cloth")
    last, X = run[-1], run[0].problem.X
    ends = np.abs(X[:, 0]) > 0.999 * X[:, 0].max()
    assert np.array_equal(np.flatnonzero(ends), np.flatnonzero(last.problem.fixed))
    assert last.contact.pairs > 20
    assert last.contact.deepest < 0.5 * thickness("twisted_cloth")
    free = ~ends & (np.abs(X[:, 0]) < 0.3)
    assert np.abs(last.x[free, 1:]).max() < 0.5 * np.abs(X[:, 2]).max()  # drawn into a rope
