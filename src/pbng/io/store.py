"""Files that appear whole or not at all, and meshes as files: what stored runs are made of."""

import io
import json
import os
import signal
import threading
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pbng.errors import InputError
from pbng.mesh import Embedding, Mesh, TetMesh, TriMesh

T = TypeVar("T")

_UNREADABLE = (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error)


def put(path: Path, data: bytes) -> None:
    """Make the file appear at once and whole, on the disk, or not at all. Raises OSError."""
    temporary = temporary_of(path)
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


def temporary_of(path: Path) -> Path:
    """The name a file has until it is whole."""
    return path.with_name(f".{path.name}.tmp")


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Ctrl-C waits until this is left: what is written is written whole, and what writes it need not expect it.

    (An archive that is interrupted between two of its parts ends with an error of its own.)
    """
    if threading.current_thread() is not threading.main_thread():  # signals come to the main thread alone
        yield
        return
    came: list[Any] = []
    handler = signal.signal(signal.SIGINT, lambda *signal_: came.append(signal_))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if came and callable(handler):
            handler(*came[0])


def packed(**arrays: Any) -> bytes:
    """The arrays as an .npz in memory, so that the disk sees one write."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def unpacked(file: Path) -> dict[str, np.ndarray]:
    """The arrays of an .npz, all read (and their checksums compared)."""
    with np.load(file, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def reading(file: Path, read: Callable[[Path], T]) -> T:
    """``read(file)``, with whatever goes wrong told as an InputError that names the file."""
    try:
        return read(file)
    except InputError as error:
        raise InputError(f"cannot read {file}: {error}") from error
    except FileNotFoundError:
        raise InputError(f"incomplete run: {file} is missing") from None
    except _UNREADABLE as error:
        raise InputError(f"cannot read {file}: it is damaged or not of a pbng run ({error!r})") from error


def mesh_arrays(mesh: Any) -> dict[str, np.ndarray]:
    """A mesh with its groups and skin as named arrays."""
    arrays = {"kind": np.array("tet" if mesh.cells.shape[1] == 4 else "triangle"), "X": mesh.X, "cells": mesh.cells}
    for kind in ("groups", "cell_groups"):
        groups = getattr(mesh, kind, {})
        arrays[kind] = np.array(json.dumps(list(groups)))  # names are free, those of zip members are not
        arrays |= {f"{kind}_{k}": index for k, index in enumerate(groups.values())}
    skin = getattr(mesh, "skin", None)
    if skin is not None:
        arrays |= {"skin_triangles": skin.triangles, "skin_parents": skin.parents, "skin_weights": skin.weights}
    return arrays


def read_mesh(file: Path) -> Mesh:
    """The mesh that :func:`mesh_arrays` described."""
    a = unpacked(file)
    named = {
        kind: {name: a[f"{kind}_{k}"] for k, name in enumerate(json.loads(str(a[kind])))}
        for kind in ("groups", "cell_groups")
    }
    if str(a["kind"]) == "triangle":
        return TriMesh(a["X"], a["cells"], **named)
    skin = None
    if "skin_triangles" in a:
        skin = Embedding(a["skin_triangles"], a["skin_parents"], a["skin_weights"])
    return TetMesh(a["X"], a["cells"], skin=skin, **named)
