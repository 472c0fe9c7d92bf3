"""From a surface to tets that carry it."""

import logging
from collections.abc import Callable
from contextlib import chdir
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np

from pbng.errors import InputError
from pbng.mesh import TetMesh, TriMesh, triangle_areas
from pbng.mesh_quality import cone_volumes, triangles_at_edges
from pbng.meshing.embedding import embed, load_igl
from pbng.meshing.stuffing import stuff

log = logging.getLogger("pbng")

Arrays = tuple[np.ndarray, np.ndarray]

CELLS_ACROSS = 30  # of the default size, along the diagonal of the bounding box
MOST_POINTS = 2e7  # of the lattice: about 6 GB of memory


def tetrahedralize(
    surface: TriMesh, cell: float | None = None, method: Literal["stuffing", "tetwild"] = "stuffing"
) -> TetMesh:
    """Fill a closed surface with tets.

    The tets carry the given surface as their ``skin``, turned outward if need be, so that it is what gets drawn and
    exported.

    ``"stuffing"`` is quick and gives well-shaped tets of one size (dihedral angles above 10 degrees) whose boundary
    cuts corners; what is thinner than a cell gets lost, though the skin still shows it. It copes with surfaces that
    have holes or intersect themselves: inside is where the winding number exceeds one half. ``"tetwild"`` (fTetWild, Hu
    et al. 2020) follows the surface to 0.1 % of its size, for which it takes more tets and up to minutes; it is
    not reproducible.

    Args:
        surface: Triangles in space.
        cell: Size [m] of the tets, roughly their longest edge; by default 1/30 of the bounding box's diagonal.
        method: How to fill it.

    Returns:
        The tets, with ``skin``.

    Raises:
        InputError: The surface is flat or encloses nothing as large as a cell, an argument is out of range, or an
            optional package is missing.
    """
    fill = {"stuffing": _stuffed, "tetwild": _wild}.get(method)
    if fill is None:
        raise InputError(f"unknown method {method!r}; choose 'stuffing' or 'tetwild'")
    if not isinstance(surface, TriMesh):
        raise InputError(f"tetrahedralize takes a TriMesh, not a {type(surface).__name__}")
    if surface.is_plane:
        raise InputError("the surface is flat and encloses no volume")
    cell = surface.size / CELLS_ACROSS if cell is None else _checked(cell, surface)
    surface, n_open = _oriented(surface)
    X, cells = fill(surface, cell)
    if len(cells) == 0:
        raise InputError(_nothing_inside(surface, cell, n_open))
    bare = TetMesh(X, cells)
    whole = cone_volumes(surface.X, surface.cells).sum()
    if not n_open and bare.volume.sum() < 0.8 * whole:
        share = bare.volume.sum() / whole
        log.warning("the tets fill %.0f %% of the surface's volume; use a cell smaller than %.3g m", 100 * share, cell)
    return TetMesh(bare.X, bare.cells, skin=embed(surface, bare))


def _checked(cell: float, surface: TriMesh) -> float:
    try:
        cell = float(cell)
    except (TypeError, ValueError):
        raise InputError(f"cell must be a length [m], not {cell!r}") from None
    if not (np.isfinite(cell) and cell > 0):
        raise InputError(f"cell must be positive and finite, not {cell:g} m")
    points = 2 * np.prod(np.ptp(surface.X, axis=0) / cell + 3)
    if points > MOST_POINTS:
        raise InputError(
            f"cell {cell:g} m is too small: it takes {points:.1g} lattice points to cover {surface.size:.3g} m"
        )
    return cell


def _oriented(surface: TriMesh) -> tuple[TriMesh, int]:
    """The surface with its triangles turned outward, and how many edges are open."""
    count, balance = triangles_at_edges(surface.cells)
    cells = surface.cells.astype(np.int64)
    n_open = int((count == 1).sum())
    if n_open:
        log.warning("the surface has %d open edges; its holes are closed where the winding number is one half", n_open)
    patch = np.zeros(len(cells), np.int64)
    if balance[count > 1].any():
        cells, patch = load_igl().bfs_orient(cells)
    inward = np.bincount(patch, cone_volumes(surface.X, cells)) < 0
    cells = np.where(inward[patch, None], cells[:, ::-1], cells)
    turned = np.einsum("fi,fi->f", triangle_areas(surface.X, cells), triangle_areas(surface.X, surface.cells)) < 0
    if not turned.any():
        return surface, n_open
    log.info("turned %d of the surface's %d triangles outward", turned.sum(), len(cells))
    return TriMesh(surface.X, cells), n_open


def _nothing_inside(surface: TriMesh, cell: float, n_open: int) -> str:
    area = surface.volume.sum()
    thickness = 2 * cone_volumes(surface.X, surface.cells).sum() / area
    what = f"cell {cell:g} m finds nothing inside the surface, which is {surface.size:.3g} m across"
    if n_open:
        return f"{what} and has {n_open} open edges: it encloses too little"
    return f"{what} but only about {thickness:.2g} m thick: choose a cell no larger than that"


def _stuffed(surface: TriMesh, cell: float) -> Arrays:
    return stuff(_inside(surface), surface.X.min(0), surface.X.max(0), cell)


def _inside(surface: TriMesh) -> Callable[[np.ndarray], np.ndarray]:
    """Where the winding number exceeds one half, of either sign: surfaces turned inside out are filled as well."""
    tree = load_igl().FastWindingNumberBVH()
    tree.init(surface.X, surface.cells.astype(np.int64))
    return lambda points: np.abs(tree.winding_number(points)) > 0.5


def _wild(surface: TriMesh, cell: float) -> Arrays:
    load_igl()  # which the skin needs: better missed now than in minutes
    try:
        import pytetwild
    except ImportError as error:
        raise InputError(f"method 'tetwild' needs pytetwild: pip install 'pbng[tetwild]' ({error})") from error
    share = min(cell / surface.size, 1.0)
    with TemporaryDirectory() as folder, chdir(folder):  # it leaves a file in the working directory
        # It takes no read-only arrays, hence the copies.
        X, cells = pytetwild.tetrahedralize(surface.X.copy(), surface.cells.copy(), edge_length_fac=share)
    used, renumbered = np.unique(cells, return_inverse=True)
    return X[used], renumbered.reshape(-1, 4)
