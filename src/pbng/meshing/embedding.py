"""Hangs the points of a surface on the tets of a mesh, so that the surface follows when the mesh deforms."""

import logging
from types import ModuleType

import numpy as np

from pbng.errors import InputError
from pbng.mesh import Embedding, TetMesh, TriMesh
from pbng.topology import incidence

log = logging.getLogger("pbng")

LOWEST = -4.0  # a weight below this would magnify the deformation of one tet too much to look right


def embed(surface: TriMesh, mesh: TetMesh) -> Embedding:
    """Embed a surface in tets by barycentric weights.

    A point in no tet hangs on the one, next to where it is closest, that has to be extrapolated least. So every affine
    motion of the mesh moves the surface alike, unless points lie several cells outside: these are first drawn nearer
    until no weight is below -4, and a log message says how many and how far.

    Args:
        surface: The surface to carry; its vertices lie in the mesh or close to it.
        mesh: The tets that carry it.

    Returns:
        The embedding, with the surface's triangles, parents (n_point, 4) and weights (n_point, 4).
    """
    igl = load_igl()
    cells = mesh.cells.astype(np.int64)
    tree = igl.AABB()
    tree.init(mesh.X, cells)
    parent = igl.in_element(mesh.X, cells, surface.X, tree)
    outside = np.flatnonzero(parent < 0)
    X = surface.X
    if len(outside):
        _, face, closest = igl.point_mesh_squared_distance(X[outside], mesh.X, mesh.surface.astype(np.int64))
        parent[outside] = _least_extrapolated(X[outside], mesh.surface[face], mesh)
        X = _drawn_nearer(X, outside, closest, parent[outside], mesh)
    return Embedding(surface.cells, mesh.cells[parent], _weights(X, parent, mesh))


def load_igl() -> ModuleType:
    """The module ``igl``; raises InputError if it is not installed."""
    try:
        import igl
    except ImportError as error:
        raise InputError(f"filling and embedding surfaces need libigl: pip install 'pbng[mesh]' ({error})") from error
    return igl


def _weights(points: np.ndarray, parent: np.ndarray, mesh: TetMesh) -> np.ndarray:
    """Barycentric weights (n, 4) of points (n, 3) in the tets parent (n,)."""
    corner = mesh.X[mesh.cells[parent]]
    edges = (corner[:, 1:] - corner[:, :1]).transpose(0, 2, 1)
    weights = np.linalg.solve(edges, (points - corner[:, 0])[:, :, None])[:, :, 0]
    return np.column_stack([1 - weights.sum(1), weights])


def _least_extrapolated(points: np.ndarray, faces: np.ndarray, mesh: TetMesh) -> np.ndarray:
    """Of the tets that touch a point's closest face, the one in which its lowest weight is highest, (n,)."""
    start, incident = incidence(mesh.cells, mesh.n_vert)
    count = (start[faces + 1] - start[faces]).ravel()
    last = np.cumsum(count)
    point = np.repeat(np.repeat(np.arange(len(points)), 3), count)
    entry = np.repeat(start[faces].ravel() - last + count, count) + np.arange(last[-1])
    tet = incident[entry] // 4
    lowest = _weights(points[point], tet, mesh).min(1)
    best = np.lexsort([lowest, point])[last.reshape(-1, 3)[:, -1] - 1]  # the last of each point's run
    return tet[best]


def _drawn_nearer(
    X: np.ndarray, outside: np.ndarray, closest: np.ndarray, parent: np.ndarray, mesh: TetMesh
) -> np.ndarray:
    """Positions (n, 3) in which points far outside are moved towards their closest points on the mesh (k, 3)."""
    far, near = _weights(X[outside], parent, mesh), _weights(closest, parent, mesh)
    drop = near - far
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(far < LOWEST, (near - LOWEST) / drop, 1).min(1)
    moved = share < 1
    if not moved.any():
        return X
    new = X.copy()
    new[outside] = closest + np.clip(share, 0, 1)[:, None] * (X[outside] - closest)
    log.warning(
        "%d of the surface's %d points lie far outside the tets and are drawn up to %.2g m nearer; use a smaller cell",
        moved.sum(),
        len(X),
        np.linalg.norm(new - X, axis=1).max(),
    )
    return new
