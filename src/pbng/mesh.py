"""Meshes at rest: frozen, validated when made, with named groups and selections."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from pbng.errors import InputError
from pbng.jit import serial
from pbng.topology import TET_EDGES, TRIANGLE_EDGES, components, hinges, tet_faces, unique_edges

log = logging.getLogger("pbng")

Interval = float | tuple[float, float]


@dataclass(frozen=True, eq=False)
class Mesh:
    """What tetrahedral and triangle meshes share; use :class:`TetMesh` or :class:`TriMesh`.

    Attributes:
        X: Rest positions [m], (n_vert, 3) float64, read-only.
        cells: Vertex indices, (n_cell, 4 or 3) int32, read-only.
        groups: Named vertex groups, name -> (k,) indices.
        cell_groups: Named cell groups (for several materials in one mesh), name -> (k,) indices.
        flipped: Indices of the cells whose orientation was corrected on construction.
    """

    X: np.ndarray
    cells: np.ndarray
    groups: Mapping[str, np.ndarray] = field(default_factory=dict, kw_only=True)
    cell_groups: Mapping[str, np.ndarray] = field(default_factory=dict, kw_only=True)
    flipped: np.ndarray = field(init=False, repr=False)

    corners = 0  # vertices a cell, set by the subclass
    cell_name = "cell"

    def __post_init__(self) -> None:
        X = _positions(self.X)
        cells = self._indices(len(X))
        cells, flipped = self._oriented(X, cells)
        if len(flipped):
            log.info("corrected the orientation of %d of %d %ss", len(flipped), len(cells), self.cell_name)
        self._set(X=_frozen(X), cells=_frozen(cells), flipped=_frozen(flipped))
        self._set(groups=self._grouped(self.groups, len(X), "vertex"))
        self._set(cell_groups=self._grouped(self.cell_groups, len(cells), self.cell_name))

    def _set(self, **values: Any) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def _indices(self, n_vert: int) -> np.ndarray:
        cells = np.asarray(self.cells)
        if cells.ndim != 2 or cells.shape[1] != self.corners or len(cells) == 0:
            raise InputError(f"cells must have shape (n, {self.corners}) with n > 0, not {cells.shape}")
        if not np.issubdtype(cells.dtype, np.integer):
            raise InputError(f"cells must be integers, not {cells.dtype}")
        outside = np.flatnonzero(((cells < 0) | (cells >= n_vert)).any(1))
        if len(outside):
            e = outside[0]
            raise InputError(
                f"{self.cell_name} {e} = {cells[e].tolist()} names a vertex outside 0 .. {n_vert - 1}"
                f" ({len(outside)} such {self.cell_name}s)"
            )
        cells = np.array(cells, np.int32, order="C")
        used = np.zeros(n_vert, bool)
        used[cells] = True
        if not used.all():
            loose = np.flatnonzero(~used)
            none = f"to no {self.cell_name}; remove"
            raise InputError(_blamed("vertex", loose, f"belongs {none} it", f"belong {none} them"))
        return cells

    def _oriented(self, X: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        raise TypeError("make a TetMesh or a TriMesh")

    def _degenerate(self, bad: np.ndarray, what: str) -> None:
        if bad.any():
            raise InputError(_blamed(self.cell_name, np.flatnonzero(bad), f"has zero {what}", f"have zero {what}"))

    @staticmethod
    def _grouped(groups: Mapping[str, Any], n: int, what: str) -> dict[str, np.ndarray]:
        out = {}
        for name, members in groups.items():
            index = np.asarray(members)
            if index.dtype == bool and index.shape != (n,):
                raise InputError(f"group {name!r}: a mask must have shape ({n},), not {index.shape}")
            index = np.flatnonzero(index) if index.dtype == bool else index.astype(np.int64).ravel()
            if len(index) and (index.min() < 0 or index.max() >= n):
                raise InputError(f"group {name!r} names a {what} outside 0 .. {n - 1}")
            out[name] = _frozen(np.unique(index))
        return out

    @property
    def n_vert(self) -> int:
        return len(self.X)

    @property
    def n_elem(self) -> int:
        return len(self.cells)

    @cached_property
    def size(self) -> float:
        """Diagonal of the bounding box [m]."""
        return float(np.linalg.norm(np.ptp(self.X, axis=0)))

    @cached_property
    def component(self) -> np.ndarray:
        """Label (n_vert,) of the connected part of each vertex."""
        return components(self.cells, self.n_vert)

    def moved(self, X: np.ndarray) -> Self:
        """The mesh with other rest positions X (n_vert, 3) [m], as when it is turned or scaled; a skin goes along.

        Raises:
            InputError: No mesh can be made of these.
        """
        return replace(self, X=X)  # made anew, so that what depends on X is checked and measured again

    def drawn(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, 3) [m] and triangles (m, 3) that stand for the mesh at x (n_vert, 3) in pictures and exports."""
        return x, self.surface

    @cached_property
    def surface(self) -> np.ndarray:
        """Triangles (m, 3) int32 of the boundary of a solid, normals outward, or of the mesh itself if it is one."""
        return self.cells

    @cached_property
    def volume(self) -> np.ndarray:
        """Rest measure of each cell, (n_elem,): volume [m³] of tets, area [m²] of triangles."""
        raise TypeError("make a TetMesh or a TriMesh")

    def where(
        self,
        which: str | np.ndarray | Callable[[np.ndarray], np.ndarray] | None = None,
        *,
        x: Interval | None = None,
        y: Interval | None = None,
        z: Interval | None = None,
        tol: float | None = None,
    ) -> np.ndarray:
        """Indices (k,) of the vertices that satisfy every given condition.

        Args:
            which: A named group, a mask (n_vert,) or indices, or a function of X returning a mask.
            x, y, z: A rest coordinate [m], or an interval (low, high) of it.
            tol: Tolerance of the coordinates [m]; by default 1e-6 of the mesh's size.

        Raises:
            InputError: The group is unknown or the mask has the wrong shape.
        """
        chosen = np.ones(self.n_vert, bool) if which is None else self._mask(which)
        eps = 1e-6 * self.size if tol is None else tol
        for axis, wanted in enumerate((x, y, z)):
            if wanted is not None:
                low, high = wanted if isinstance(wanted, tuple | list) else (wanted, wanted)
                chosen &= (self.X[:, axis] >= low - eps) & (self.X[:, axis] <= high + eps)
        return np.flatnonzero(chosen)

    def _mask(self, which: Any) -> np.ndarray:
        if isinstance(which, str):
            if which not in self.groups:
                raise InputError(f"no vertex group {which!r}; this mesh has {sorted(self.groups) or 'none'}")
            which = self.groups[which]
        elif callable(which):
            which = which(self.X)
        which = np.asarray(which)
        if which.dtype == bool:
            if which.shape != (self.n_vert,):
                raise InputError(f"a vertex mask must have shape ({self.n_vert},), not {which.shape}")
            return which.copy()
        if not np.issubdtype(which.dtype, np.integer):
            raise InputError(f"a selection must be a mask or integer indices, not {which.dtype}")
        if len(which) and (which.min() < 0 or which.max() >= self.n_vert):
            raise InputError(f"a selection names a vertex outside 0 .. {self.n_vert - 1}")
        mask = np.zeros(self.n_vert, bool)
        mask[which] = True
        return mask


@dataclass(frozen=True, eq=False)
class Embedding:
    """A surface carried by a mesh: each of its points is a fixed weighted mean of the vertices of one cell.

    Attributes:
        triangles: Vertex indices into the embedded points, (m, 3).
        parents: Mesh vertices each point hangs on, (n_point, k).
        weights: Their barycentric weights, (n_point, k), rows sum to one; negative where a point lies outside.
    """

    triangles: np.ndarray
    parents: np.ndarray
    weights: np.ndarray

    def points(self, x: np.ndarray) -> np.ndarray:
        """Positions (n_point, 3) [m] of the surface's points when the mesh is at x (n_vert, 3)."""
        return np.einsum("pk,pki->pi", self.weights, x[self.parents])


@dataclass(frozen=True, eq=False)
class TetMesh(Mesh):
    """Tetrahedra in space: ``TetMesh(X, cells)`` with X (n_vert, 3) [m] and cells (n_elem, 4).

    A ``skin`` is a finer surface that the tets carry: it is what gets drawn and exported in place of their own.

    Cells given with negative volume are reoriented (see ``flipped``). Raises :class:`pbng.InputError` that names the
    cell or vertex for a wrong shape or index, a vertex that is not finite or not used, a flat cell, a cell given twice,
    and cells that overlap across a common face (an inverted cell).
    """

    skin: Embedding | None = field(default=None, kw_only=True)

    corners = 4
    cell_name = "tet"

    def _oriented(self, X: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        volume, longest = _measure_tets(X, cells)
        self._degenerate(np.abs(volume) <= 1e-12 * longest**3, "volume")
        flipped = np.flatnonzero(volume < 0)
        cells[flipped] = cells[flipped][:, [0, 1, 3, 2]]
        surface, (code, i, j) = tet_faces(cells, len(X))
        if code:
            a, b = sorted((int(i) // 4, int(j) // 4))
            shared = sorted(set(cells[a].tolist()) & set(cells[b].tolist()))
            raise InputError(
                {
                    1: f"tets {a} and {b} lie on the same side of their common face {shared}: one of them is inverted",
                    2: f"face {shared} of tets {a} and {b} belongs to more than two tets",
                    3: f"tets {a} and {b} have the same vertices {shared}",
                }[int(code)]
            )
        self.__dict__["surface"] = _frozen(surface)  # known already: faces are matched to find overlaps
        self.__dict__["volume"] = _frozen(np.abs(volume))
        return cells, flipped

    @cached_property
    def surface(self) -> np.ndarray:
        """Boundary triangles (m, 3) int32, normals outward."""
        return tet_faces(self.cells, self.n_vert)[0]

    def drawn(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points and triangles that stand for the mesh in pictures and exports: the skin's if it has one."""
        return super().drawn(x) if self.skin is None else (self.skin.points(x), self.skin.triangles)

    @cached_property
    def volume(self) -> np.ndarray:
        """Rest volume of each cell [m³], (n_elem,)."""
        return tet_volumes(self.X, self.cells)

    @cached_property
    def edges(self) -> np.ndarray:
        """Edges (m, 2) int32, the smaller vertex first."""
        return unique_edges(self.cells, TET_EDGES)


@dataclass(frozen=True, eq=False)
class TriMesh(Mesh):
    """Triangles: a plane domain (X of shape (n, 2), or z constant) or a surface in space.

    Triangles of a plane domain are oriented counter-clockwise (see ``flipped``); a surface keeps its orientation.
    Raises :class:`pbng.InputError` as :class:`TetMesh` does.
    """

    corners = 3
    cell_name = "triangle"

    def _oriented(self, X: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        area = triangle_areas(X, cells)
        edge = X[cells[:, TRIANGLE_EDGES[:, 1]]] - X[cells[:, TRIANGLE_EDGES[:, 0]]]
        longest2 = np.einsum("eij,eij->ei", edge, edge).max(1)
        self._degenerate(np.linalg.norm(area, axis=1) <= 1e-12 * longest2, "area")
        first, again = _repeated(cells)
        if len(again):
            raise InputError(f"triangles {first[0]} and {again[0]} have the same vertices")
        if np.ptp(X[:, 2]) > 0:
            return cells, np.empty(0, np.int64)
        flipped = np.flatnonzero(area[:, 2] < 0)
        cells[flipped] = cells[flipped][:, [0, 2, 1]]
        return cells, flipped

    @cached_property
    def boundary_edges(self) -> np.ndarray:
        """Edges (m, 2) int32 that belong to one triangle only."""
        pairs = np.sort(self.cells[:, TRIANGLE_EDGES].reshape(-1, 2), axis=1)
        edges, count = np.unique(pairs, axis=0, return_counts=True)
        return edges[count == 1]

    @cached_property
    def hinges(self) -> np.ndarray:
        """Hinges (m, 4) int32, one for each edge between two triangles: its ends, then the third vertices of the two.

        Raises:
            InputError: An edge belongs to more than two triangles, or two neighbours are not oriented alike.
        """
        found, code, bad = hinges(self.cells)
        if code:
            shared = sorted(set.intersection(*(set(self.cells[e].tolist()) for e in bad)))
            what = ", ".join(str(e) for e in bad)
            raise InputError(
                {
                    1: f"edge {shared} belongs to {len(bad)} triangles: {what}; a surface has at most two at an edge",
                    2: f"triangles {what} are not oriented alike: both run the same way along their edge {shared}",
                }[code]
            )
        return _frozen(found)

    @property
    def is_plane(self) -> bool:
        """Whether the mesh lies in a plane of constant z."""
        return bool(np.ptp(self.X[:, 2]) == 0)

    @cached_property
    def volume(self) -> np.ndarray:
        """Rest area of each cell [m²], which is its volume per unit thickness, (n_elem,)."""
        return np.linalg.norm(triangle_areas(self.X, self.cells), axis=1)

    @cached_property
    def edges(self) -> np.ndarray:
        """Edges (m, 2) int32, the smaller vertex first."""
        return unique_edges(self.cells, TRIANGLE_EDGES)


def tet_volumes(X: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Signed volume [m³] of tets, (n_elem,)."""
    return _measure_tets(X, cells)[0]


@serial
def _measure_tets(X, cells):
    """Signed volume and longest edge of each tet."""
    volume, longest = np.empty(len(cells)), np.empty(len(cells))
    e = np.empty((6, 3))
    for n in range(len(cells)):
        for k in range(3):
            a, b, c, d = X[cells[n, 0], k], X[cells[n, 1], k], X[cells[n, 2], k], X[cells[n, 3], k]
            e[0, k], e[1, k], e[2, k], e[3, k], e[4, k], e[5, k] = b - a, c - a, d - a, c - b, d - b, d - c
        volume[n] = (
            e[0, 0] * (e[1, 1] * e[2, 2] - e[1, 2] * e[2, 1])
            + e[0, 1] * (e[1, 2] * e[2, 0] - e[1, 0] * e[2, 2])
            + e[0, 2] * (e[1, 0] * e[2, 1] - e[1, 1] * e[2, 0])
        ) / 6
        most = 0.0
        for j in range(6):
            most = max(most, e[j, 0] ** 2 + e[j, 1] ** 2 + e[j, 2] ** 2)
        longest[n] = most**0.5
    return volume, longest


def triangle_areas(X: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Area vectors [m²] of triangles (half the cross product of two edges), (n_elem, 3)."""
    return np.cross(X[cells[:, 1]] - X[cells[:, 0]], X[cells[:, 2]] - X[cells[:, 0]]) / 2


def _positions(X: Any) -> np.ndarray:
    X = np.array(X, np.float64, order="C")
    if X.ndim == 2 and X.shape[1] == 2:
        X = np.column_stack([X, np.zeros(len(X))])
    if X.ndim != 2 or X.shape[1] != 3 or len(X) == 0:
        raise InputError(f"X must have shape (n_vert, 3), not {X.shape}")
    bad = np.flatnonzero(~np.isfinite(X).all(1))
    if len(bad):
        what = f"not finite: X[{bad[0]}] = {X[bad[0]].tolist()}"
        raise InputError(_blamed("vertex", bad, f"is {what}", f"are {what}"))
    return X


def _repeated(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of cells that have the same vertices as another, and of those others."""
    rows = np.sort(cells, axis=1)
    order = np.lexsort(rows.T)
    same = (rows[order[1:]] == rows[order[:-1]]).all(1)
    return order[:-1][same], order[1:][same]


def _blamed(what: str, index: np.ndarray, one: str, many: str) -> str:
    """``tet 7`` and what ``one`` does, or ``tets 7, 9, 12, ... (40 in all)`` and what ``many`` do."""
    if len(index) == 1:
        return f"{what} {index[0]} {one}"
    plural = {"vertex": "vertices"}.get(what, what + "s")
    shown = ", ".join(str(i) for i in index[:5]) + (f", ... ({len(index)} in all)" if len(index) > 5 else "")
    return f"{plural} {shown} {many}"


def _frozen(a: np.ndarray) -> np.ndarray:
    a.flags.writeable = False
    return a
