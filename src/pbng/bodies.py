"""Bodies of a scene, and what is chosen of them: vertices, and points between vertices."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from pbng.errors import InputError
from pbng.materials.base import Material
from pbng.materials.bending import Bending
from pbng.mesh import Mesh, TriMesh

ROUNDING = 1e-9  # what weights that should sum to one may be off by


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh with its material or materials, as part of a scene."""

    name: str
    mesh: Mesh
    materials: tuple[tuple[Material, np.ndarray], ...]  # with the cells each holds for
    start: int  # number of its first vertex in the scene
    bending: Bending | None = None  # of cloth

    def __post_init__(self) -> None:
        """Check that mesh, materials and bending go together.

        Raises:
            InputError: They do not, or cloth has an edge of more than two triangles or neighbours not oriented alike.
        """
        who, surface = f"body {self.name!r}", [m for m, _ in self.materials if m.surface]
        if surface and not isinstance(self.mesh, TriMesh):
            raise InputError(f"{who}: {type(surface[0]).__name__} is a material of surfaces, and its mesh is of tets")
        if surface and len(surface) < len(self.materials):
            raise InputError(f"{who}: some of its materials are of surfaces and some are not")
        if self.bending is not None and not isinstance(self.bending, Bending):
            raise InputError(f"{who}: expected Bending(k=...) after the material, not {self.bending!r}")
        if self.bending is not None and not surface:
            raise InputError(f"{who}: bending is for cloth; its material must be of surfaces, such as Membrane")
        if isinstance(self.mesh, TriMesh) and not surface and not self.mesh.is_plane:
            raise InputError(
                f"{who}: a solid in two dimensions must lie in a plane of constant z; for cloth take Membrane"
            )
        if surface and isinstance(self.mesh, TriMesh):
            try:
                self.mesh.hinges  # noqa: B018
            except InputError as error:
                raise InputError(f"{who}: {error}") from None

    def where(self, *which: Any, **conditions: Any) -> "Selection":
        """Vertices of this body, chosen as by :meth:`pbng.mesh.Mesh.where`."""
        words = [repr(w) if isinstance(w, str) else type(w).__name__ for w in which]
        words += [f"{k}={v}" for k, v in conditions.items()]
        return Selection(self, self.mesh.where(*which, **conditions), ", ".join(words))

    def points(self, vertices: Any, weights: Any) -> "Points":
        """Points of this body, each a weighted mean of some of its vertices.

        Args:
            vertices: Numbers of its vertices, (m, s).
            weights: Their weights, (m, s), each row with sum one; vertices of weight zero do not count.

        Raises:
            InputError: Shapes differ, a vertex does not exist, a weight is not finite or a row does not sum to one.
        """
        return Points(self, np.array(vertices), np.array(weights, float))

    @property
    def is_cloth(self) -> bool:
        """Whether it is a surface in space: triangles of a material of surfaces."""
        return any(m.surface for m, _ in self.materials)

    @property
    def faces(self) -> np.ndarray:
        """What bounds it, of cloth all of it: triangles (k, 3), or in the plane edges (k, 2), by its own vertices."""
        if isinstance(self.mesh, TriMesh) and not self.is_cloth:
            return self.mesh.boundary_edges
        return self.mesh.surface


@dataclass(frozen=True, eq=False)
class Selection:
    """Vertices (k,) of a body, and the words that chose them."""

    body: Body
    vertices: np.ndarray
    words: str

    def __len__(self) -> int:
        return len(self.vertices)

    @property
    def index(self) -> np.ndarray:
        """Their numbers in the scene, (k,)."""
        return self.body.start + self.vertices

    @property
    def points(self) -> "Points":
        """The vertices as points."""
        return Points(self.body, self.vertices[:, None], np.ones((len(self), 1)))

    @property
    def faces(self) -> np.ndarray:
        """The body's faces whose vertices are all selected, (k, 3) or (k, 2), by the body's own vertices."""
        chosen = np.zeros(self.body.mesh.n_vert, bool)
        chosen[self.vertices] = True
        faces = self.body.faces
        return faces[chosen[faces].all(1)]


@dataclass(frozen=True, eq=False)
class Points:
    """Points of a body, means of its ``vertices`` (m, s) with ``weights`` (m, s); see :meth:`Body.points`."""

    body: Body
    vertices: np.ndarray
    weights: np.ndarray

    def __post_init__(self) -> None:
        name, n = self.body.name, self.body.mesh.n_vert
        shape = self.vertices.shape
        if self.vertices.ndim != 2 or 0 in shape or self.weights.shape != shape:
            raise InputError(
                f"points of body {name!r}: vertices and weights must have one shape (m, s) with m, s > 0,"
                f" not {shape} and {self.weights.shape}"
            )
        if not np.issubdtype(self.vertices.dtype, np.integer):
            raise InputError(f"points of body {name!r}: vertices must be whole numbers, not {self.vertices.dtype}")
        bad = np.flatnonzero(((self.vertices < 0) | (self.vertices >= n)).any(1))
        if len(bad):
            raise InputError(
                f"points of body {name!r}: point {bad[0]} names vertices {self.vertices[bad[0]].tolist()};"
                f" there are {n}"
            )
        total = self.weights.sum(1)
        bad = np.flatnonzero(~(np.abs(total - 1) <= ROUNDING))
        if len(bad):
            raise InputError(
                f"points of body {name!r}: the weights of point {bad[0]} sum to {total[bad[0]]:.9g}, not to 1"
            )

    def __len__(self) -> int:
        return len(self.vertices)

    @property
    def index(self) -> np.ndarray:
        """Numbers of the vertices in the scene, (m, s)."""
        return self.body.start + self.vertices

    @property
    def X(self) -> np.ndarray:
        """Rest positions [m], (m, 3)."""
        return np.einsum("ms,msd->md", self.weights, self.body.mesh.X[self.vertices])
