"""Small problems and hard starts; the expensive part of a test is compiling, so tests share their materials."""

import numpy as np
import pytest
from grids import coarse_space, shaken
from models import RootMooney, SoftVolume

import pbng
from pbng.coarse import space

STARTS = ("scrambled", "mirrored", "plane", "line", "point")


@pytest.fixture
def rng():
    return np.random.default_rng(20240717)


def hard_start(problem, kind, seed=0):
    """Positions of a free body gone wrong; prescribed vertices stay in place."""
    X, rng = problem.X, np.random.default_rng(seed)
    low, size = X.min(0), np.ptp(X, axis=0)
    plane = size[2] == 0
    x = {
        "scrambled": low + rng.random(X.shape) * size,
        "mirrored": X * [-1, 1, 1],
        "plane": X * [1, 1, 0],
        "line": X * ([0, 1, 0] if plane else [0, 0, 1]),
        "point": np.broadcast_to(low + 0.3 * size, X.shape),
    }[kind]
    return problem.constrain(np.where(problem.fixed[:, None], X, x), 0.0)


def held_box(material, vertices=(4, 3, 3), size=(1.0, 0.7, 0.7)):
    """A box held at x = 0."""
    scene = pbng.Scene()
    body = scene.add(pbng.shapes.box(size, vertices), material)
    scene.pin(body.where(x=0.0))
    return scene.compile()


def twisted_bar(material=None, vertices=(6, 4, 4), turns=0.25, stretch=0.2):
    """A bar held at one end; the other is turned and drawn out at once."""
    scene = pbng.Scene()
    body = scene.add(pbng.shapes.box((1.5, 1.0, 1.0), vertices), material or pbng.Corotated(E=1e5, nu=0.3))
    scene.pin(body.where(x=0.0))
    scene.move(body.where(x=1.5), pbng.Rotate("x", turns) + pbng.Translate((stretch, 0, 0)))
    return scene


def mixed_problem():
    """Five materials on tets and three on plane triangles, two bodies of each, under load: one pair of kernels."""
    E = 1e5
    box = pbng.shapes.box((1.0, 0.8, 0.6), (5, 4, 3))
    third = np.arange(box.n_elem) % 3
    box = pbng.TetMesh(box.X, box.cells, cell_groups={"a": third == 0, "b": third == 1, "c": third == 2})
    plate = pbng.shapes.rectangle((1.0, 0.7), (5, 4))
    half = np.arange(plate.n_elem) % 2
    plate = pbng.TriMesh(plate.X, plate.cells, cell_groups={"a": half == 0, "b": half == 1})
    scene = pbng.Scene(gravity=(0.3, -9.8, 0.0))
    a = scene.add(
        box,
        {
            "a": pbng.Corotated(E=E, nu=0.3),
            "b": pbng.NeoHookean(E=2 * E, nu=0.45),
            "c": SoftVolume(E=0.5 * E, nu=0.2),
        },
    )
    b = scene.add(pbng.shapes.box((0.5, 0.5, 0.5), 3), pbng.LinearElastic(E=E, nu=0.3), at=(2.0, 0.0, 0.0))
    c = scene.add(plate, {"a": pbng.NeoHookean(E=E, nu=0.3), "b": pbng.LinearElastic(E=E, nu=-0.2)}, at=(0.0, 3.0, 0.0))
    d = scene.add(pbng.shapes.rectangle((0.5, 0.5), 3), RootMooney(E=E, nu=0.3), at=(2.0, 3.0, 0.0))
    for body, x in ((a, 0.0), (b, 2.0), (c, 0.0), (d, 2.0)):
        scene.pin(body.where(x=x))
    scene.force(a.where(x=1.0), (10.0, -20.0, 5.0))
    return scene.compile()


@pytest.fixture(scope="session")
def mixed():
    return mixed_problem()


@pytest.fixture
def small_bottom(monkeypatch):
    """Grids are coarsened as far as they go, not only until a dense matrix is cheap."""
    monkeypatch.setattr(space, "DENSE", 10)


@pytest.fixture(scope="session")
def tower():
    """A box held at one side with grids of 64, 27 and 8 nodes, and the stiffness of a stretched and shaken state."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(space, "DENSE", 10)
        problem = held_box(pbng.Corotated(E=1e5, nu=0.3), (12, 12, 12), (1.0, 1.0, 1.0))
        coarse, packed = coarse_space(problem)
    x = shaken(problem, 1.1, 0.01)
    coarse.refresh(packed.pack(x))
    return coarse, packed
