"""Time of what contact asks: the closest triangle of points near a body, the closest edge, the tet around a vertex."""

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numba
import numpy as np

from pbng.bench.timing import interleaved
from pbng.contact.bvh import BoxTree
from pbng.contact.queries import closest_edges, closest_triangles, containing_tets
from pbng.contact.rings import neighbourhoods, spans
from pbng.shapes import sphere
from pbng.solvers.threads import check_threads
from pbng.topology import TRIANGLE_EDGES, unique_edges

HEIGHT = 1.8  # of the body [m]
CUT = 0.02  # reach of the queries that are cut off [m]
Row = dict[str, Any]


def measure(n: int, points: int, tets: int, threads: list[int], rounds: int) -> list[Row]:
    """One row a query and number of threads; rates in millions of points (or edges) a second."""
    for count in threads:
        check_threads("bench contact", count)
    x, triangles = body(n)
    p = near(x, triangles, points)
    edges = unique_edges(triangles, TRIANGLE_EDGES)
    around = neighbourhoods(edges, len(x), 2)
    rows = []
    for count in threads:
        numba.set_num_threads(count)
        rows.append(_triangles(x, triangles, p, rounds) | {"threads": count})
        rows.append(_edges(x, edges, around, rounds) | {"threads": count})
        if tets:
            rows.append(_tets(tets, rounds) | {"threads": count})
    return rows


def body(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a closed surface with hills and hollows, ``n`` vertices across, 1.8 m tall."""
    ball = sphere(1.0, n)
    used, triangles = np.unique(ball.surface, return_inverse=True)
    x = ball.X[used] * (0.3, 1.0, 0.2)
    x *= 1 + 0.15 * np.sin(9 * x[:, [1, 2, 0]])
    return x * (HEIGHT / np.ptp(x[:, 1])), triangles.reshape(-1, 3).astype(np.int32)


def near(x: np.ndarray, triangles: np.ndarray, k: int, seed: int = 0) -> np.ndarray:
    """Points (k, 3) in random order, 5 mm under to 30 mm over the surface."""
    rng = np.random.default_rng(seed)
    a, b, c = x[triangles[rng.integers(0, len(triangles), k)]].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    w = rng.dirichlet([1, 1, 1], k)
    return w[:, :1] * a + w[:, 1:2] * b + w[:, 2:] * c + normal * rng.uniform(-0.005, 0.03, (k, 1))


def _triangles(x: np.ndarray, triangles: np.ndarray, p: np.ndarray, rounds: int) -> Row:
    tree = BoxTree(x, triangles)
    contestants: dict[str, Callable[[], Any]] = {
        "near": lambda: closest_triangles(tree, x, p),
        "cut": lambda: closest_triangles(tree, x, p, CUT),
    }
    if find_spec("igl") is not None:
        import igl

        wide = triangles.astype(np.int64)
        contestants["igl"] = lambda: igl.point_mesh_squared_distance(p, x, wide)
    return _row("closest triangle", tree, x, triangles, len(p), contestants, rounds)


def _edges(x: np.ndarray, edges: np.ndarray, around: tuple[np.ndarray, np.ndarray], rounds: int) -> Row:
    """All edges of a body against all, those within two rings left out."""
    tree = BoxTree(x, edges)
    left_out = spans(tree.order, *around)
    contestants = {"cut": lambda: closest_edges(tree, x, edges, CUT, excluded=left_out)}
    return _row("closest edge", tree, x, edges, len(edges), contestants, rounds)


def _tets(n: int, rounds: int) -> Row:
    """All vertices of six solid balls, which reach into each other, against all tets."""
    ball = sphere(0.5, n)
    shifts = 0.95 * np.stack(np.meshgrid([0, 1], [0, 1, 2], [0], indexing="ij"), -1).reshape(-1, 3)
    x = (ball.X + shifts[:, None]).reshape(-1, 3)
    cells = (ball.cells + ball.n_vert * np.arange(6, dtype=np.int32)[:, None, None]).reshape(-1, 4)
    v = np.arange(len(x), dtype=np.int32)
    tree = BoxTree(x, cells)
    return _row(
        "containing tet", tree, x, cells, len(v), {"near": lambda: containing_tets(tree, x, x, vertex=v)}, rounds
    )


def _row(
    query: str,
    tree: BoxTree,
    x: np.ndarray,
    cells: np.ndarray,
    k: int,
    contestants: dict[str, Callable[[], Any]],
    rounds: int,
) -> Row:
    upkeep = {"build": lambda: BoxTree(x, cells), "refit": lambda: tree.refit(x)}
    ms = {name: float(np.median(s) * 1e3) for name, s in interleaved(upkeep, rounds, calls=3).items()}
    rates = {name: float(k / np.median(s) / 1e6) for name, s in interleaved(contestants, rounds).items()}
    row = {"query": query, "primitives": len(cells), "points": k, "build_ms": ms["build"], "refit_ms": ms["refit"]}
    if "igl" in rates:
        row["ratio"] = rates["near"] / rates["igl"]
    return row | rates
