"""Small stand-ins for what a simulation yields, for tests of what stores, exports and draws it."""

from dataclasses import dataclass, field
from enum import Enum
from itertools import permutations

import numpy as np

from pbng.mesh import TetMesh, TriMesh


class Status(Enum):
    CONVERGED = "converged"
    BUDGET = "budget spent"


@dataclass
class Result:
    status: Status = Status.CONVERGED
    iterations: int = 12
    residuals: np.ndarray = field(default_factory=lambda: np.geomspace(1.0, 1e-3, 5))
    monitored: np.ndarray = field(default_factory=lambda: np.array([0, 3, 6, 9, 12]))
    energy: float = 0.25
    seconds: float = 0.01
    inverted: int = 0


@dataclass
class Body:
    name: str
    start: int
    stop: int
    mesh: object


@dataclass
class Problem:
    name: str
    bodies: tuple


@dataclass
class Frame:
    index: int
    t: float
    x: np.ndarray
    problem: Problem
    result: Result = field(default_factory=Result)


def box(n=(3, 3, 3), size=(1.0, 1.0, 1.0), at=(0.0, 0.0, 0.0)):
    """A box of n cells along each axis, each cut into the six tets around its diagonal."""
    grid = np.indices([k + 1 for k in n]).reshape(3, -1).T
    number = np.arange(len(grid)).reshape([k + 1 for k in n])
    corner = np.indices(n).reshape(3, -1).T
    paths = [np.cumsum([[0, 0, 0], *np.eye(3, dtype=int)[list(p)]], axis=0) for p in permutations(range(3))]
    cells = np.concatenate([np.stack([number[tuple((corner + step).T)] for step in path], 1) for path in paths])
    return TetMesh(grid * np.divide(size, n) + at, cells)


def sheet(n=8, height=None):
    """A square of n x n cells in the plane z = 0, or level at the given height."""
    grid = np.indices((n + 1, n + 1)).reshape(2, -1).T
    number = np.arange(len(grid)).reshape(n + 1, n + 1)
    a, b, c, d = (s.ravel() for s in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    cells = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    flat = grid / n - 0.5
    if height is None:
        return TriMesh(flat, cells)
    return TriMesh(np.column_stack([flat[:, 0], np.full(len(flat), height), flat[:, 1]]), cells)


def twisted(X, turns):
    """X turned about the x axis by an angle that grows along it."""
    s = (X[:, 0] - X[:, 0].min()) / np.ptp(X[:, 0])
    y0, z0 = (X[:, 1].min() + X[:, 1].max()) / 2, (X[:, 2].min() + X[:, 2].max()) / 2
    c, s_ = np.cos(2 * np.pi * turns * s), np.sin(2 * np.pi * turns * s)
    y, z = X[:, 1] - y0, X[:, 2] - z0
    return np.column_stack([X[:, 0], y0 + c * y - s_ * z, z0 + s_ * y + c * z])


def frames(meshes, n, motion=lambda X, s: twisted(X, 0.25 * s), dtype=np.float32, fps=30.0):
    """n frames of the meshes moved by ``motion(X, s)``, s from 0 to 1."""
    stops = np.cumsum([len(m.X) for m in meshes])
    bodies = tuple(Body(f"body {k}", int(e - len(m.X)), int(e), m) for k, (m, e) in enumerate(zip(meshes, stops)))
    problem = Problem("a run", bodies)
    for i in range(n):
        s = i / max(n - 1, 1)
        x = np.concatenate([motion(m.X, s) for m in meshes]).astype(dtype)
        yield Frame(i, i / fps, x, problem)
