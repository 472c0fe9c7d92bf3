"""Meshes from files and to files: tets by meshio or as NumPy arrays, surfaces by trimesh."""

import io
import logging
import os
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from pbng.errors import InputError
from pbng.io.store import mesh_arrays, packed, put, read_mesh as read_stored, unpacked
from pbng.mesh import TetMesh, TriMesh, triangle_areas

log = logging.getLogger("pbng")

MESHES = (".msh", ".vtu", ".mesh", ".npz")
SURFACES = (".obj", ".ply", ".stl", ".off")
WRITTEN = (".npz", ".msh", ".vtu")

_MODULE = {".msh": "gmsh", ".vtu": "vtu", ".mesh": "medit"}  # the part of meshio that reads it
_TAGS = ("gmsh:physical", "medit:ref")  # cell data that holds numbers of groups
_FLAT = ("vertex", "line", "triangle", "quad", "polygon")  # cells of fewer dimensions, by how their names begin

Path_ = str | os.PathLike[str]
Groups = dict[str, np.ndarray]


def read_mesh(path: Path_) -> TetMesh:
    """Read tets from a Gmsh .msh, VTK .vtu or Medit .mesh file, or from an .npz.

    Groups are kept: of tets as ``cell_groups``, and points, or the vertices of triangles and edges that the file puts
    in a group, as ``groups``. They have the file's names, or else ``"physical 3"`` (Gmsh) and ``"ref 3"`` (Medit).
    An .npz is one that :func:`save_mesh` wrote, or holds X (n_vert, 3) [m], cells (n_elem, 4) and, if need be, indices
    named ``groups/NAME`` and ``cell_groups/NAME``. Vertices that no tet uses are dropped; of curved tets the corners
    are kept.

    Raises:
        InputError: The file is missing, damaged, of another kind or without tets, the mesh is invalid (see
            :class:`pbng.TetMesh`), or meshio is not installed. The message begins with the path.
    """
    path = Path(path)
    with _named(path):
        suffix = _checked(path, MESHES, dict.fromkeys(SURFACES, "read_surface, then tetrahedralize"))
        return _from_arrays(path) if suffix == ".npz" else _from_meshio(path, suffix)


def read_surface(path: Path_) -> TriMesh:
    """Read triangles from an .obj, .ply, .stl or .off file.

    Polygons are split, vertices at equal positions become one (as an .stl needs, and an .obj with seams of texture),
    and then degenerate triangles, repeated ones and vertices that nothing uses are dropped. What remains keeps the
    order of the file, so a clean file comes back as it is.

    Raises:
        InputError: The file is missing, damaged, of another kind or without triangles, a vertex is not finite, or
            trimesh is not installed. The message begins with the path.
    """
    path = Path(path)
    with _named(path):
        suffix = _checked(path, SURFACES, dict.fromkeys(MESHES, "read_mesh"))
        load = _extra("trimesh", suffix).load_mesh
        with _silenced():
            # Without processing, which would merge by a tolerance that is absolute, and drop vertices that are NaN.
            surface = load(path, process=False, maintain_order=True, skip_materials=True)
        faces = getattr(surface, "faces", ())
        if len(faces) == 0:
            raise InputError("it has no triangles")
        return _cleaned(np.asarray(surface.vertices, np.float64), np.asarray(faces, np.int64), path)


def save_mesh(mesh: TetMesh, path: Path_) -> None:
    """Write tets to an .npz, .msh or .vtu file, replacing it.

    :func:`read_mesh` gives the mesh back with its groups; only an .npz also keeps the skin.

    Raises:
        InputError: The extension is another, the folder is missing, or meshio is not installed.
    """
    path = Path(path)
    with _named(path, "cannot be written"):
        suffix = path.suffix.lower()
        if suffix not in WRITTEN:
            raise InputError(f"cannot write {suffix or 'a file without extension'}; known are {' '.join(WRITTEN)}")
        if not path.parent.is_dir():
            raise InputError("its folder does not exist")
        if suffix == ".npz":
            put(path, packed(**mesh_arrays(mesh)))
            return
        if mesh.skin is not None:
            log.info("%s: the skin is left out; only an .npz keeps it", path)
        meshio = _extra("meshio", suffix)
        points = {f"group:{name}": _mask(index, mesh.n_vert) for name, index in mesh.groups.items()}
        cells = {f"cell_group:{name}": [_mask(index, mesh.n_elem)] for name, index in mesh.cell_groups.items()}
        with _silenced():
            meshio.Mesh(mesh.X, [("tetra", mesh.cells)], points, cells).write(path, {".msh": "gmsh"}.get(suffix, "vtu"))


@contextmanager
def _named(path: Path, failed: str = "cannot be read: it is damaged or of another kind") -> Iterator[None]:
    """Whatever goes wrong inside is told as an InputError that names the file."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (Exception, SystemExit) as error:  # readers of damaged files raise almost anything, and meshio may exit
        what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        raise InputError(f"{path}: {failed} ({what})") from error


@contextmanager
def _silenced() -> Iterator[None]:
    """What a library prints goes to the log, and its warnings nowhere: the mesh is checked in any case."""
    printed = io.StringIO()
    with redirect_stdout(printed), redirect_stderr(printed), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
    if printed.getvalue():
        log.debug("%s", printed.getvalue().strip())


def _checked(path: Path, known: Iterable[str], instead: dict[str, str]) -> str:
    """The extension of a file that can be opened."""
    suffix = path.suffix.lower()
    if not path.exists():
        raise InputError("no such file")
    if path.is_dir():
        raise InputError("it is a folder")
    if suffix in instead:
        raise InputError(f"{suffix} files are read by {instead[suffix]}")
    if suffix not in known:
        raise InputError(f"unknown extension {suffix!r}; known are {' '.join(known)}")
    if path.stat().st_size == 0:
        raise InputError("the file is empty")
    return suffix


def _extra(module: str, suffix: str) -> Any:
    try:
        return import_module(module)
    except ImportError as error:
        library = module.partition(".")[0]
        raise InputError(f"{suffix} files need {library}: pip install 'pbng[mesh]' ({error})") from error


def _from_arrays(path: Path) -> TetMesh:
    arrays = unpacked(path)
    missing = [name for name in ("X", "cells") if name not in arrays]
    if missing:
        raise InputError(f"array {missing[0]!r} is missing; the file has {sorted(arrays)}")
    if arrays["cells"].ndim == 2 and arrays["cells"].shape[1] == 3:
        raise InputError(_NO_TETS.format("triangles"))
    if "kind" in arrays:
        mesh = read_stored(path)
        assert isinstance(mesh, TetMesh)
        return mesh
    groups, cell_groups = (
        {name.removeprefix(kind): index for name, index in arrays.items() if name.startswith(kind)}
        for kind in ("groups/", "cell_groups/")
    )
    return _used_only(arrays["X"], arrays["cells"], groups, cell_groups, path)


_NO_TETS = "it has only {}, no tets; read a surface with read_surface and fill it with tetrahedralize"


def _from_meshio(path: Path, suffix: str) -> TetMesh:
    # The reader of the format itself: meshio.read would print what it raises, and leave the program.
    read: Callable[[str], Any] = _extra(f"meshio.{_MODULE[suffix]}", suffix).read
    with _silenced():
        file = read(str(path))
    kinds = [block.type for block in file.cells]
    is_tet = [kind.startswith("tetra") for kind in kinds]
    others = sorted({kind for kind, tet in zip(kinds, is_tet) if not tet and not kind.startswith(_FLAT)})
    if others:
        raise InputError(f"it has cells other than tets: {', '.join(others)}")
    if not any(len(block.data) for block, tet in zip(file.cells, is_tet) if tet):
        raise InputError(_NO_TETS.format(" and ".join(sorted({f"{kind}s" for kind in kinds})) or "vertices"))
    if any(kind != "tetra" for kind, tet in zip(kinds, is_tet) if tet):
        log.warning("%s: curved tets become straight ones", path)
    cells = np.concatenate([block.data[:, :4] for block, tet in zip(file.cells, is_tet) if tet])
    groups, cell_groups = _groups(file, is_tet)
    return _used_only(file.points, cells, groups, cell_groups, path)


def _groups(file: Any, is_tet: list[bool]) -> tuple[Groups, Groups]:
    """Groups of vertices and of tets, from whatever the formats know: sets, tags, and masks of save_mesh."""
    groups = {name: np.asarray(index) for name, index in file.point_sets.items()}
    groups |= {k.removeprefix("group:"): v != 0 for k, v in file.point_data.items() if k.startswith("group:")}
    groups = {name: np.flatnonzero(g) if g.dtype == bool else g for name, g in groups.items()}
    chosen: dict[str, list[np.ndarray]] = {}  # a mask for each block of cells
    for name, blocks in file.cell_sets.items():
        if not name.startswith("gmsh:"):
            index = [np.asarray([] if b is None else b, np.int64) for b in blocks]
            chosen[name] = [_mask(i, len(block.data)) > 0 for i, block in zip(index, file.cells)]
    for key, values in file.cell_data.items():
        if key.startswith("cell_group:"):
            chosen[key.removeprefix("cell_group:")] = [np.asarray(v) != 0 for v in values]
        elif key in _TAGS:
            chosen |= _tagged(file, key.partition(":")[2], values)
    cell_groups = {}
    for name, masks in chosen.items():
        of_tets = np.concatenate([m for m, tet in zip(masks, is_tet) if tet])
        if of_tets.any():
            cell_groups[name] = np.flatnonzero(of_tets)
        flat = [block.data[m] for block, m, tet in zip(file.cells, masks, is_tet) if not tet and m.any()]
        if flat:
            groups[name] = np.unique(np.concatenate([data.ravel() for data in flat]))
    return groups, cell_groups


def _tagged(file: Any, what: str, values: list[np.ndarray]) -> dict[str, list[np.ndarray]]:
    """Groups of cells that have the same tag in the same dimension; 0 means none."""
    named = {(int(tag), int(dim)): name for name, (tag, dim) in file.field_data.items()}
    chosen: dict[str, list[np.ndarray]] = {}
    for b, block in enumerate(file.cells):
        for tag in np.unique(values[b]):
            if tag != 0:
                name = named.get((int(tag), block.dim), f"{what} {tag}")
                masks = chosen.setdefault(name, [np.zeros(len(other.data), bool) for other in file.cells])
                masks[b] |= values[b] == tag
    return chosen


def _mask(index: np.ndarray, n: int) -> np.ndarray:
    mask = np.zeros(n, np.int32)
    mask[index] = 1
    return mask


def _used_only(X: np.ndarray, cells: np.ndarray, groups: Groups, cell_groups: Groups, path: Path) -> TetMesh:
    """The mesh without the vertices that no tet uses."""
    in_range = cells.ndim == 2 and cells.size and np.issubdtype(cells.dtype, np.integer)
    if not in_range or cells.min() < 0 or cells.max() >= len(X):
        return TetMesh(X, cells)  # which says what is wrong
    used = np.zeros(len(X), bool)
    used[cells] = True
    if not used.all():
        log.info("%s: dropped %d vertices that no tet uses", path, (~used).sum())
        new = np.where(used, np.cumsum(used) - 1, -1)
        groups = {name: new[index][used[index]] for name, index in groups.items()}
        X, cells = X[used], new[cells]
    return TetMesh(X, cells, groups=groups, cell_groups=cell_groups)


def _cleaned(X: np.ndarray, faces: np.ndarray, path: Path) -> TriMesh:
    bad = np.flatnonzero(~np.isfinite(X).all(1))
    if len(bad):
        raise InputError(f"vertex {bad[0]} is not finite: {X[bad[0]].tolist()}")
    if faces.min() < 0 or faces.max() >= len(X):
        raise InputError(f"a triangle names a vertex outside 0 .. {len(X) - 1}")
    n_vert, n_face = len(X), len(faces)
    _, first, same = np.unique(X, axis=0, return_index=True, return_inverse=True)
    faces = first[same.reshape(-1)][faces]  # the first vertex at each position stands for the others
    edge = X[faces] - X[np.roll(faces, 1, axis=1)]
    longest2 = np.einsum("fai,fai->fa", edge, edge).max(1)
    faces = faces[np.linalg.norm(triangle_areas(X, faces), axis=1) > 1e-12 * longest2]
    _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(once)]
    if len(faces) == 0:
        raise InputError("all its triangles are degenerate")
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    if len(used) < n_vert or len(faces) < n_face:
        dropped = n_vert - len(used), n_face - len(faces)
        log.info("%s: merged or dropped %d vertices, dropped %d degenerate or repeated triangles", path, *dropped)
    return TriMesh(X[used], faces)
