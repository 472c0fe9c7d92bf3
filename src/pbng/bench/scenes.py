"""The problems that are measured."""

import numpy as np
from scipy.spatial import Delaunay

from pbng import shapes
from pbng.errors import InputError
from pbng.materials.base import Material
from pbng.materials.corotated import Corotated
from pbng.materials.neo_hookean import NeoHookean
from pbng.materials.stable_neo_hookean import StableNeoHookean
from pbng.mesh import TetMesh, tet_volumes
from pbng.motions import Rotate, Translate
from pbng.problem import Problem
from pbng.scene import Scene
from pbng.topology import TET_EDGES

MODELS: dict[str, type[Material]] = {
    "corotated": Corotated,
    "neo-hookean": NeoHookean,
    "stable-neo-hookean": StableNeoHookean,
}


def model_of(name: str) -> type[Material]:
    """The material of that name, as ``pbng bench --model`` takes them.

    Raises:
        InputError: There is none; it names those that there are.
    """
    if name not in MODELS:
        raise InputError(f"no model {name!r} to measure; there are {', '.join(MODELS)}")
    return MODELS[name]


def hard_start(mesh: TetMesh, material: Material) -> Problem:
    """A block held at x = 0 whose other end is turned by 90° and moved by half its length in one step."""
    scene = Scene(name="hard start")
    block = scene.add(mesh, material, name="block")
    low, high = mesh.X[:, 0].min(), mesh.X[:, 0].max()
    scene.pin(block.where(x=low))
    scene.move(block.where(x=high), Rotate("x", turns=0.25) + Translate((0.5 * (high - low), 0, 0)))
    return scene.compile()


def box(n: int) -> TetMesh:
    """The paper's unit block of n³ vertices."""
    return shapes.box(vertices=n)


def delaunay(n: int, seed: int = 0) -> TetMesh:
    """Delaunay tets of a jittered grid of n³ vertices, vertices and cells in random order, without slivers.

    Raises:
        InputError: n is below 2.
    """
    if n < 2:
        raise InputError(f"delaunay: there must be at least 2 vertices along an edge, not {n}")
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3).astype(float)
    inside = (grid > 0) & (grid < n - 1)
    X = (grid + inside * rng.uniform(-0.3, 0.3, grid.shape)) / (n - 1)
    cells = Delaunay(X).simplices
    edges = X[cells[:, TET_EDGES[:, 1]]] - X[cells[:, TET_EDGES[:, 0]]]
    longest = np.linalg.norm(edges, axis=2).max(1)
    cells = cells[np.abs(6 * tet_volumes(X, cells)) > 0.02 * longest**3]
    order = rng.permutation(len(X))
    new = np.empty(len(X), int)
    new[order] = np.arange(len(X))
    X, cells = X[order], new[cells][rng.permutation(len(cells))]
    used = np.zeros(len(X), bool)
    used[cells] = True
    return TetMesh(X[used], (np.cumsum(used) - 1)[cells])
