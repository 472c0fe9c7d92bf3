"""The nearest point of several half-spaces, against a quadratic program; and what is done where there is none."""

import numpy as np
import pytest
from scipy.optimize import nnls

from pbng.contact.halfspaces import FAR, MANY, HalfSpaces


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def turned(planes, rng):
    """Unit normals in a frame turned at random."""
    return unit(np.asarray(planes, float)) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]


def wedge(angle):
    """Two normals that are ``angle`` degrees from one another."""
    return [[1.0, 0, 0], [np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle)), 0]]


def corner(sides, height):
    """Normals evenly about an axis."""
    turn = 2 * np.pi / sides * np.arange(sides)
    return np.column_stack([np.cos(turn), np.sin(turn), np.full(sides, height)])


def nearest(x, plane, level):
    """The point of half-spaces that is nearest to x, as a least distance problem (Lawson, Hanson); None if none is."""
    E = np.vstack([plane.T, level - plane @ x])
    left = E @ nnls(E, [0.0, 0.0, 0.0, 1.0])[0] - [0.0, 0.0, 0.0, 1.0]
    return None if np.linalg.norm(left) < 1e-8 else x - left[:3] / left[3]


def moved(x, plane, level, held=None, far=FAR):
    """One vertex in its half-spaces, which is what it was plus what pushes it, and the pushes."""
    y, none = np.array([x]), np.zeros(len(level), int)
    pushed = HalfSpaces(none, plane).move_in(y, level, held, far)
    assert np.isfinite(y).all()
    np.testing.assert_allclose(y[0], x + pushed @ plane, atol=1e-11 * (1 + np.abs(pushed).max()))
    assert held is not None or pushed.min() >= 0
    return y[0], pushed


SETS = {
    **{f"{n} at random": (lambda rng, n=n: rng.normal(size=(n, 3))) for n in (1, 2, 3, 4, 6, 9)},
    **{f"a wedge of {a}": (lambda rng, a=a: wedge(a)) for a in (1, 2, 5, 10, 30, 90, 150, 170, 175, 178, 179)},
    **{f"a corner of {n}": (lambda rng, n=n: corner(n, rng.uniform(0.2, 1))) for n in (3, 4, 5, 6)},
    "duplicates": lambda rng: rng.normal(size=(3, 3))[rng.integers(3, size=6)],
    "near duplicates": lambda rng: rng.normal(size=3) + 10.0 ** rng.uniform(-12, -2) * rng.normal(size=(3, 3)),
}


@pytest.mark.parametrize("levels", ["at random", "equal", "none"])
@pytest.mark.parametrize("name", SETS)
def test_a_vertex_moves_to_the_nearest_point_of_its_half_spaces(rng, name, levels):
    near = 0
    for _ in range(100):
        plane, x = turned(SETS[name](rng), rng), 2 * rng.normal(size=3)
        level = {"at random": rng.normal(size=len(plane)), "equal": rng.normal() * np.ones(len(plane))}.get(levels)
        far = FAR
        if level is None:  # forces: what is left of them is in a cone
            level, far = np.zeros(len(plane)), np.inf
        y, _ = moved(x, plane, level, far=far)
        depth, wanted = (level - plane @ x).max(), nearest(x, plane, level)
        if wanted is not None and np.linalg.norm(wanted - x) < 0.99 * far * max(depth, 1e-300):
            np.testing.assert_allclose(y, wanted, atol=1e-7)
            near += 1
        elif depth <= 0:
            assert (y == x).all()
        else:
            assert np.linalg.norm(y - x) < FAR * depth
    assert near > 10


@pytest.mark.parametrize("angle", [10, 30, 90, 150, 170])
def test_who_is_held_comes_to_lie_on_the_planes(rng, angle):
    for _ in range(50):
        plane, x = turned([*wedge(angle), [0, 0, 1]], rng), rng.normal(size=3)
        level = plane @ x + 0.01 * rng.normal(size=3)
        y, pushed = moved(x, plane, level, np.array([True, True, False]))
        height = plane @ y - level
        assert np.abs(height[:2]).max() < 1e-10
        assert height[2] > -1e-10
        assert pushed[2] >= 0
        aside, _ = moved(x, plane, np.where([True, True, False], level, -np.inf), np.array([True, True, False]))
        assert np.abs(plane[:2] @ aside - level[:2]).max() < 1e-10


def test_where_there_is_no_room_a_vertex_stays_near(rng):
    """Between plates that have met, straight or at a slant, and in more half-spaces than are looked at."""
    for slant in (0.0, 1e-12, 1e-6, 1e-3):
        n = unit(rng.normal(size=3))
        plane, x = unit(np.array([n, -n + slant * rng.normal(size=3), rng.normal(size=3)])), rng.normal(size=3)
        depth = np.array([0.1, 0.2, -1.0])
        y, pushed = moved(x, plane, plane @ x + depth)
        assert np.linalg.norm(y - x) < 1.0
        assert pushed.max() < 100
    plane = np.tile(turned(np.eye(3), rng), (MANY, 1))
    y, _ = moved(x, plane, plane @ x + 0.1)
    np.testing.assert_allclose(plane @ (y - x), 0.1, atol=1e-9)


def test_vertices_do_not_know_of_each_other(rng):
    """In any order of half-spaces, with any layout and precision; whoever has none, or is inside, is left alone."""
    vertex = rng.permutation(np.repeat(rng.permutation(60)[:40], 1 + np.arange(40) % 4)).astype(np.int32)
    plane, level = unit(rng.normal(size=(len(vertex), 3))), rng.normal(size=len(vertex))
    x = 2 * rng.normal(size=(60, 3))
    every = HalfSpaces(vertex, plane)
    y = x.copy()
    pushed = every.move_in(y, level)
    np.testing.assert_allclose(every.height(x, level), (plane * x[vertex]).sum(1) - level, atol=1e-14)
    for v in range(60):
        mine = vertex == v
        if mine.any():
            alone, by = moved(x[v], plane[mine], level[mine])
            assert alone.tobytes() == y[v].tobytes()
            assert by.tobytes() == pushed[mine].tobytes()
        if (plane[mine] @ x[v] >= level[mine]).all():
            assert (y[v] == x[v]).all()
    wide = np.zeros((60, 4), np.float32)
    wide[:, :3] = x
    every.move_in(wide[:, :3], level)
    np.testing.assert_allclose(wide[:, :3], y, atol=1e-3)
    assert (wide[:, 3] == 0).all()


def test_no_half_spaces():
    x = np.ones((3, 3))
    none = HalfSpaces(np.empty(0, np.int32), np.empty((0, 3)))
    assert len(none.move_in(x, np.empty(0))) == len(none.height(x, np.empty(0))) == 0
    assert (x == 1).all()
