"""Stored runs in the formats of other programs: ParaView, Blender, Houdini, and whatever reads meshes.

    vtu   tets and triangles a frame, with displacements, and a .pvd that gives the times   (ParaView)
    vtp   the drawn surface a frame, and a .pvd                                              (ParaView, Houdini)
    obj   the drawn surface a frame, as text
    ply   the drawn surface a frame, binary, with the bits of the run
    pc2   one .obj of the drawn surface at rest and one point cache of all frames            (Blender's Mesh Cache)

The bodies of a run, and if wanted its colliders, are merged into one file a frame, unless ``split`` asks for a series a
body.
"""

import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO
from xml.sax.saxutils import quoteattr

import numpy as np

from pbng.errors import InputError
from pbng.io.colliders import behind
from pbng.io.frames import Run, StoredFrame

FORMATS = ("vtu", "vtp", "obj", "ply", "pc2")


def export(
    run: Run | str | os.PathLike[str],
    path: str | os.PathLike[str],
    format: str | None = None,
    *,
    split: bool = False,
    colliders: bool = False,
) -> list[Path]:
    """Write a run in another format; returns the files written, the one to open last.

    Args:
        run: A run or its folder.
        path: A folder, made if need be, whose name the files take; or, if it ends in a format, the folder and name of
            the files ("out/twist.obj" gives out/twist_0000.obj, ...). Files of the same name are replaced.
        format: One of ``FORMATS``; by default what the path ends in.
        split: Write each body into files of its own, named after it, rather than all into one.
        colliders: Write the surfaces of colliders too, as if they were further bodies.

    Raises:
        InputError: The format is unknown, the run cannot be read, or a file cannot be written.
    """
    run = Run(run) if isinstance(run, str | os.PathLike) else run
    path = Path(path)
    suffix = path.suffix.lstrip(".").lower()
    format = suffix if format is None else format
    if format not in FORMATS:
        raise InputError(f"cannot export {format or str(path)!r}: expected one of {', '.join(FORMATS)}")
    folder, name = (path.parent, path.stem) if suffix == format else (path, path.name)
    further = behind(run.bodies, run.colliders) if colliders else ()
    write = _point_cache if format == "pc2" else _series
    try:
        folder.mkdir(parents=True, exist_ok=True)
        written = []
        for part, bodies in _parts((*run.bodies, *further), name, split):
            written += write(run, bodies, folder / f"{part}.{format}")
    except OSError as error:
        raise InputError(f"cannot export to {error.filename or folder}: {error.strerror or error}") from error
    return written


def drawn(bodies: Sequence[Any], x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The surfaces of bodies as one: points (n, 3) [m], triangles (m, 3), and the body (n,) of each point."""
    points, triangles, owner, n = [], [], [], 0
    for k, body in enumerate(bodies):
        p, t = body.mesh.drawn(x[body.start : body.stop])
        points.append(np.asarray(p, x.dtype))
        triangles.append(np.asarray(t, np.int64) + n)
        owner.append(np.full(len(p), k, np.int32))
        n += len(p)
    return np.concatenate(points), np.concatenate(triangles), np.concatenate(owner)


def _parts(bodies: Sequence[Any], name: str, split: bool) -> Iterator[tuple[str, Sequence[Any]]]:
    if not split:
        yield name, bodies
        return
    for k, body in enumerate(bodies):
        label = re.sub(r"[^\w.-]+", "_", body.name)
        unique = sum(other.name == body.name for other in bodies) == 1
        yield (f"{name}_{label}" if unique and label else f"{name}_{label}{k}"), [body]


def _positions(frame: StoredFrame) -> np.ndarray:
    """Positions (n, 3) [m] of bodies and, behind them, colliders."""
    return np.concatenate([frame.x, *(points.astype(frame.x.dtype) for points in frame.colliders)])


def _series(run: Run, bodies: Sequence[Any], path: Path) -> list[Path]:
    """One file a frame, and for ParaView one that gives their times."""
    kind = path.suffix[1:]
    digits = max(4, len(str(len(run) - 1)))
    written, times = [], []
    for k in range(len(run)):
        frame = run[k]
        x = _positions(frame)
        file = path.with_name(f"{path.stem}_{k:0{digits}d}{path.suffix}")
        if kind == "obj":
            _write(file, partial(_obj, bodies, x))
        elif kind == "ply":
            _write(file, partial(_ply, bodies, x))
        else:
            dataset = (_vtk_cells if kind == "vtu" else _vtk_surface)(bodies, x)
            with _whole(file):
                dataset.save(file)
        written.append(file)
        times.append(frame.t)
    if kind in ("vtu", "vtp"):
        entries = (f'<DataSet timestep="{t!r}" file={quoteattr(f.name)}/>' for t, f in zip(times, written))
        text = '<VTKFile type="Collection" version="0.1">\n<Collection>\n{}\n</Collection>\n</VTKFile>\n'
        index = path.with_suffix(".pvd")
        _write(index, lambda out: out.write(text.format("\n".join(entries)).encode()))
        written.append(index)
    return written


def _point_cache(run: Run, bodies: Sequence[Any], path: Path) -> list[Path]:
    """The topology as .obj and the points of all frames as .pc2, both of one object whose points keep their order."""
    rest = np.zeros((max(body.stop for body in bodies), 3))
    for body in bodies:
        rest[body.start : body.stop] = body.mesh.X
    topology = path.with_suffix(".obj")
    _write(topology, partial(_obj, bodies, rest))

    def cache(out: BinaryIO) -> None:
        n_point = len(drawn(bodies, rest)[0])
        out.write(b"POINTCACHE2\0")
        out.write(np.array([1, n_point], "<i4").tobytes())
        out.write(np.array([0, 1], "<f4").tobytes())  # first frame, frames a sample
        out.write(np.array(len(run), "<i4").tobytes())
        for k in range(len(run)):
            out.write(drawn(bodies, _positions(run[k]))[0].astype("<f4").tobytes())

    _write(path, cache)
    return [topology, path]


def _obj(bodies: Sequence[Any], x: np.ndarray, out: BinaryIO) -> None:
    points, triangles, owner = drawn(bodies, x)
    number = "%.9g" if points.dtype == np.float32 else "%.17g"  # enough digits to read back the same bits
    line = f"v {number} {number} {number}\n"
    out.write((line * len(points) % tuple(points.ravel().tolist())).encode())
    for k, body in enumerate(bodies):
        mine = triangles[owner[triangles[:, 0]] == k] + 1
        # Groups, not objects: Blender makes one mesh of them, as a point cache needs.
        label = re.sub(r"\s+", "_", body.name) or k
        out.write(f"g {label}\n".encode())
        out.write(("f %d %d %d\n" * len(mine) % tuple(mine.ravel().tolist())).encode())


def _ply(bodies: Sequence[Any], x: np.ndarray, out: BinaryIO) -> None:
    points, triangles, _ = drawn(bodies, x)
    real = "float" if points.dtype == np.float32 else "double"
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *(f"property {real} {axis}" for axis in "xyz"),
        f"element face {len(triangles)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    faces = np.empty(len(triangles), [("n", "u1"), ("v", "<i4", 3)])
    faces["n"], faces["v"] = 3, triangles
    out.write(("\n".join(header) + "\n").encode())
    out.write(points.astype(points.dtype.newbyteorder("<")).tobytes())
    out.write(faces.tobytes())


def _vtk_cells(bodies: Sequence[Any], x: np.ndarray) -> Any:
    """All cells (not the skins) as a pyvista grid, with displacements [m] and the body of each point and cell."""
    pv = _pyvista()
    first = np.cumsum([0, *(body.stop - body.start for body in bodies)])
    cells = {}
    for corners, kind in ((4, pv.CellType.TETRA), (3, pv.CellType.TRIANGLE)):
        these = [b.mesh.cells + n for b, n in zip(bodies, first) if b.mesh.cells.shape[1] == corners]
        if these:
            cells[kind] = np.concatenate(these)
    points = np.concatenate([x[b.start : b.stop] for b in bodies])
    grid = pv.UnstructuredGrid(cells, points)
    rest = np.concatenate([b.mesh.X for b in bodies])
    grid.point_data["displacement"] = (points - rest).astype(x.dtype)
    owner = np.repeat(np.arange(len(bodies), dtype=np.int32), np.diff(first))
    grid.point_data["body"] = owner
    grid.cell_data["body"] = owner[np.concatenate([c[:, 0] for c in cells.values()])]
    return grid


def _vtk_surface(bodies: Sequence[Any], x: np.ndarray) -> Any:
    points, triangles, owner = drawn(bodies, x)
    surface = _pyvista().PolyData.from_regular_faces(points, triangles)
    surface.point_data["body"] = owner
    return surface


def _pyvista() -> Any:
    try:
        import pyvista
    except ImportError as error:
        raise InputError(f"vtu and vtp need pyvista: pip install 'pbng[view]' ({error})") from error
    return pyvista


def _write(path: Path, fill: Callable[[BinaryIO], Any]) -> None:
    with _whole(path), open(path, "wb") as out:
        fill(out)


@contextmanager
def _whole(path: Path) -> Iterator[None]:
    """Removes the file if the writing of it fails."""
    try:
        yield
    except BaseException:
        with suppress(OSError):
            path.unlink(missing_ok=True)
        raise
