"""How good a mesh is: sizes, angles, shapes of its cells, and whether its boundary is closed."""

from dataclasses import dataclass

import numpy as np

from pbng.mesh import TetMesh, TriMesh
from pbng.topology import TET_EDGES, TET_FACES, TRIANGLE_EDGES


@dataclass(frozen=True)
class Quality:
    """What :func:`quality` finds.

    Attributes:
        kind: ``"tet"`` or ``"triangle"``.
        n_vert, n_elem: Counts of vertices and cells.
        n_surface: Triangles of the surface.
        components: Parts that share no vertex.
        size: Extents (x, y, z) of the bounding box [m].
        volume: Volume [m³] that the surface encloses, negative if it is turned inside out; None if not watertight.
        area: Area of the surface [m²].
        angle: Smallest, 1st percentile and largest angle [deg]: dihedral angles of tets, corners of triangles. The
            percentile is that of the smallest angle of each cell.
        edge: Shortest, median and longest edge [m].
        shape: Smallest, 1st percentile and median mean-ratio quality of the cells; 1 is regular, 0 is flat.
        watertight: Whether the surface is closed and consistently oriented: its triangles run along every edge as
            often one way as the other.
        open_edges: Edges of the surface that belong to one triangle.
        nonmanifold_edges: Edges of the surface that belong to more than two.
    """

    kind: str
    n_vert: int
    n_elem: int
    n_surface: int
    components: int
    size: tuple[float, float, float]
    volume: float | None
    area: float
    angle: tuple[float, float, float]
    edge: tuple[float, float, float]
    shape: tuple[float, float, float]
    watertight: bool
    open_edges: int
    nonmanifold_edges: int

    def rows(self) -> list[tuple[str, str]]:
        """(name, value) in words, for a table."""
        angle = "dihedral angles" if self.kind == "tet" else "angles"
        boundary = "watertight" if self.watertight else "not consistently oriented"
        if self.open_edges:
            boundary = f"{self.open_edges:,} open edges"
        if self.nonmanifold_edges:
            boundary += f", {self.nonmanifold_edges:,} edges of more than two triangles"
        volume = [] if self.volume is None else [("volume", f"{self.volume:.6g} m³")]
        return [
            ("vertices", f"{self.n_vert:,}"),
            (f"{self.kind}s", f"{self.n_elem:,}"),
            ("parts", f"{self.components:,}"),
            ("size", " x ".join(f"{s:.4g}" for s in self.size) + " m"),
            *volume,
            ("surface", f"{self.n_surface:,} triangles, {self.area:.6g} m², {boundary}"),
            ("edges", f"{self.edge[0]:.3g} to {self.edge[2]:.3g} m, median {self.edge[1]:.3g} m"),
            (angle, f"{self.angle[0]:.1f}° to {self.angle[2]:.1f}°, 1 % of {self.kind}s below {self.angle[1]:.1f}°"),
            (
                "shape (mean ratio)",
                f"min {self.shape[0]:.3f}, 1 % below {self.shape[1]:.3f}, median {self.shape[2]:.3f}",
            ),
        ]

    def __str__(self) -> str:
        rows = self.rows()
        width = max(len(name) for name, _ in rows)
        return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)


def quality(mesh: TetMesh | TriMesh) -> Quality:
    """Measure a mesh at rest.

    Args:
        mesh: Tets or triangles. A skin is not looked at.
    """
    tets = isinstance(mesh, TetMesh)
    angles = dihedral_angles(mesh.X, mesh.cells) if tets else corner_angles(mesh.X, mesh.cells)
    smallest = angles.min(1)
    length = np.linalg.norm(mesh.X[mesh.edges[:, 1]] - mesh.X[mesh.edges[:, 0]], axis=1)
    shape = mean_ratio(mesh.X, mesh.cells)
    per_edge, balance = triangles_at_edges(mesh.surface)
    corner = mesh.X[mesh.surface]
    area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2
    watertight = not balance.any()
    return Quality(
        kind=mesh.cell_name,
        n_vert=mesh.n_vert,
        n_elem=mesh.n_elem,
        n_surface=len(mesh.surface),
        components=int(mesh.component.max()) + 1,
        size=tuple(float(s) for s in np.ptp(mesh.X, axis=0)),  # type: ignore[arg-type]
        volume=float(cone_volumes(mesh.X, mesh.surface).sum()) if watertight else None,
        area=float(np.linalg.norm(area, axis=1).sum()),
        angle=(float(smallest.min()), float(np.percentile(smallest, 1)), float(angles.max())),
        edge=(float(length.min()), float(np.median(length)), float(length.max())),
        shape=(float(shape.min()), float(np.percentile(shape, 1)), float(np.median(shape))),
        watertight=watertight,
        open_edges=int((per_edge == 1).sum()),
        nonmanifold_edges=int((per_edge > 2).sum()),
    )


def dihedral_angles(X: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Angles [deg] between the faces of tets, (n_elem, 6)."""
    corner = X[cells[:, TET_FACES]]
    normal = np.cross(corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0])
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    cosine = -np.einsum("eai,eai->ea", normal[:, TET_EDGES[:, 0]], normal[:, TET_EDGES[:, 1]])
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def corner_angles(X: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Angles [deg] at the corners of triangles, (n_elem, 3)."""
    corner = X[cells]
    a, b = np.roll(corner, -1, axis=1) - corner, np.roll(corner, -2, axis=1) - corner
    sine, cosine = np.linalg.norm(np.cross(a, b), axis=2), np.einsum("eai,eai->ea", a, b)
    return np.degrees(np.arctan2(sine, cosine))


def mean_ratio(X: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Mean-ratio quality of tets or triangles, (n_elem,): 1 for regular ones, 0 for flat ones.

    12 (3 V)^(2/3) / Σ l² of tets, 4 √3 A / Σ l² of triangles (Liu and Joe 1994), l the lengths of the edges.
    """
    corner = X[cells]
    local = TET_EDGES if cells.shape[1] == 4 else TRIANGLE_EDGES
    edge = corner[:, local[:, 1]] - corner[:, local[:, 0]]
    total = np.einsum("eai,eai->e", edge, edge)
    side = corner[:, 1:] - corner[:, :1]
    if cells.shape[1] == 4:
        return 12 * (np.abs(np.linalg.det(side)) / 2) ** (2 / 3) / total
    return 2 * np.sqrt(3) * np.linalg.norm(np.cross(side[:, 0], side[:, 1]), axis=1) / total


def triangles_at_edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How many triangles meet at each edge, (n_edge,), and how many more run along it one way than the other."""
    ends = triangles[:, TRIANGLE_EDGES].reshape(-1, 2).astype(np.int64)
    low, high = ends.min(1), ends.max(1)
    _, edge, count = np.unique(low << 32 | high, return_inverse=True, return_counts=True)
    forward = np.bincount(edge, ends[:, 0] == low).astype(np.int64)
    return count, 2 * forward - count


def cone_volumes(X: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Signed volumes [m³] between triangles and a common point, (n,); their sum is what a closed surface encloses.

    The sum is negative if the normals point inward.
    """
    a, b, c = (X[triangles[:, k]] - X[triangles[0, 0]] for k in range(3))
    return np.einsum("ei,ei->e", np.cross(a, b), c) / 6
