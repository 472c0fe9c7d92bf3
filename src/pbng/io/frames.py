"""Frames on disk: a run is a folder of whole files, so whatever stops the writer leaves every finished frame readable.

    twist/run.json            what the run is: bodies, frames a second, anything the user adds; marks the folder as ours
    twist/body_000.npz        one mesh a body, with groups and skin
    twist/collider_000.npz    one surface a collider
    twist/frame_000000.npz    one file a frame: positions, status, residuals, contact, points of colliders that move

Each file is written under a temporary name and moved into place once it is complete and on the disk. A run is marked
before it has frames and unmarked after it has lost them, so no order of events leaves frames without their mark.
"""

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self, overload

import numpy as np

from pbng import __version__
from pbng.errors import InputError
from pbng.io.colliders import ColliderShape, colliders_of, shapes_of
from pbng.io.store import mesh_arrays, packed, put, read_mesh, reading, temporary_of, uninterrupted, unpacked
from pbng.mesh import Mesh, TriMesh

FORMAT = "pbng run"
FORMAT_VERSION = 1
MANIFEST = "run.json"
_FRAME = re.compile(r"frame_(\d{6,})\.npz")
_OURS = re.compile(r"run\.json|(body|collider)_\d{3,}\.npz|frame_\d{6,}\.npz")
_CONTACT = "contact_"  # what the numbers of a contact report are stored under begins so


@dataclass(frozen=True, eq=False)
class StoredBody:
    """A body of a stored run: its mesh at rest and its vertices ``x[start:stop]`` in every frame."""

    name: str
    start: int
    stop: int
    mesh: Mesh


@dataclass(frozen=True, eq=False)
class StoredContact:
    """What touched at the end of a frame, as :class:`pbng.equilibrium.ContactReport` has it."""

    pairs: int
    walls: int
    deepest: float
    mean: float
    size: float
    vertices: np.ndarray = field(repr=False)
    recolored: int
    repacked: int
    detect_seconds: float
    pack_seconds: float
    seconds: float


@dataclass(frozen=True, eq=False)
class StoredFrame:
    """A frame read back: positions x [m] (n_vert, 3) at time t [s], with what the solver said of it.

    ``residuals`` [N] (k,) are those of the iterations ``monitored`` (k,), ``energy`` is in J, ``seconds`` [s] the
    solver's time. If the run had inertia there are velocities v [m/s] (n_vert, 3), and if it had weak constraints there
    are ``springs`` [m] (m, 2, 3), their ends. If something could touch, ``contact`` tells what did; ``colliders`` are
    the points [m] (n, 3) of each of the run's colliders.
    """

    index: int
    t: float
    x: np.ndarray = field(repr=False)
    status: str
    iterations: int
    residuals: np.ndarray = field(repr=False)
    monitored: np.ndarray = field(repr=False)
    energy: float
    seconds: float
    inverted: int
    v: np.ndarray | None = field(default=None, repr=False)
    springs: np.ndarray | None = field(default=None, repr=False)
    contact: StoredContact | None = None
    colliders: tuple[np.ndarray, ...] = field(default=(), repr=False)


class FrameWriter:
    """Writes frames into a folder as they come: ``with FrameWriter("twist") as out: out.write(frame)``.

    Args:
        path: The run's folder, made if need be; the name is free ("twist.h5" is a folder too). One writer at a time.
        fps: Frames a second at which the run is meant to be played.
        overwrite: Replace the run that the folder holds, when the first frame comes. Other files in it are kept, and
            a folder that is not a run is never touched.
        append: Continue the run that the folder holds, whose bodies and colliders must be the same; its fps and info
            stay.
        info: Anything worth keeping with the run that JSON can hold.

    Raises:
        InputError: The folder cannot be made or written, is a file, is not empty and not a run, or holds a run and
            neither ``overwrite`` nor ``append`` is given.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        fps: float = 30.0,
        overwrite: bool = False,
        append: bool = False,
        info: Mapping[str, Any] | None = None,
    ) -> None:
        if overwrite and append:
            raise InputError("a run is either overwritten or appended to, not both")
        if not 0 < fps < np.inf:
            raise InputError(f"fps must be positive, not {fps}")
        self.path = Path(path)
        self.fps = float(fps)
        self.info = dict(info or {})
        self.n_written = 0  #: frames the run holds
        self._n_vert: int | None = None
        try:
            json.dumps(self.info)
        except (TypeError, ValueError) as error:
            raise InputError(f"info cannot be written as JSON: {error}") from None
        self._claim(overwrite, append)

    def _claim(self, overwrite: bool, append: bool) -> None:
        path = self.path
        if path.exists() and not path.is_dir():
            raise InputError(f"cannot write frames to {path}: it is a file, not a folder")
        try:
            path.mkdir(parents=True, exist_ok=True)
            others = [entry for entry in os.listdir(path) if not _is_temporary(entry)]
            ours = _is_run(path)
            if others and not ours:
                raise InputError(f"cannot write frames to {path}: it is not empty and not a pbng run")
            frames = _frame_files(path) if ours else {}
            if frames and not (overwrite or append):
                held = f"{path} already holds a run of {len(frames)} frames"
                raise InputError(f"{held}; overwrite=True replaces it, append=True continues it")
            for entry in os.listdir(path):
                if _is_temporary(entry):  # left by a writer that was killed
                    (path / entry).unlink()
            probe = temporary_of(path / MANIFEST)  # permissions do not tell: try
            probe.write_bytes(b"")
            probe.unlink()
        except OSError as error:
            raise InputError(f"cannot write frames to {path}: {error.strerror or error}") from error
        if append:
            self.n_written = len(_in_order(path, frames))

    @uninterrupted()
    def write(self, frame: Any) -> None:
        """Add a frame: an object with ``index, t, x, result, problem`` as :func:`pbng.simulate` yields them.

        Ctrl-C waits until it is done.

        Raises:
            InputError: The frame does not fit the run, or it could not be written (the disk is full, ...); the frames
                before it are intact and nothing is left of this one.
        """
        x, result = np.asarray(frame.x), frame.result
        n_vert = max(int(body.stop) for body in frame.problem.bodies) if self._n_vert is None else self._n_vert
        if x.shape != (n_vert, 3):
            raise InputError(f"frame {frame.index} has positions of shape {x.shape}, expected ({n_vert}, 3)")
        data = packed(
            index=np.int64(frame.index),
            t=np.float64(frame.t),
            x=x,
            status=np.array(getattr(result.status, "name", str(result.status))),
            iterations=np.int64(result.iterations),
            residuals=np.asarray(result.residuals, np.float64),
            monitored=np.asarray(result.monitored, np.int64),
            energy=np.float64(result.energy),
            seconds=np.float64(result.seconds),
            inverted=np.int64(result.inverted),
            **dict(_further(frame)),
        )
        try:
            if self._n_vert is None:
                self._begin(frame.problem)
                self._n_vert = n_vert
            put(self.path / f"frame_{self.n_written:06d}.npz", data)
        except OSError as error:
            raise InputError(
                f"frame {frame.index} was not written to {self.path}: {error.strerror or error}; "
                f"the {self.n_written} frames before it are intact"
            ) from error
        self.n_written += 1

    def _begin(self, problem: Any) -> None:
        bodies, colliders = list(problem.bodies), shapes_of(problem)
        if self.n_written:  # appending
            _require_same(self.path, Run(self.path), bodies, colliders)
            return
        # From the last frame down: stopped half-way, what is left is a shorter run, or one without frames.
        for _, file in sorted(_frame_files(self.path).items(), reverse=True):
            file.unlink()
        entries = [
            {"name": str(b.name), "start": int(b.start), "stop": int(b.stop), "mesh": f"body_{k:03d}.npz"}
            for k, b in enumerate(bodies)
        ]
        shapes = [
            {"name": c.name, "kind": c.kind, "moves": c.moves, "mesh": f"collider_{k:03d}.npz"}
            for k, c in enumerate(colliders)
        ]
        manifest = {
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "pbng": __version__,
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "name": str(getattr(problem, "name", "") or self.path.stem),
            "fps": self.fps,
            "bodies": entries,
            "colliders": shapes,
            "info": self.info,
        }
        put(self.path / MANIFEST, (json.dumps(manifest, indent=1) + "\n").encode())
        for file in self.path.iterdir():
            if _OURS.fullmatch(file.name) and file.name != MANIFEST:
                file.unlink()
        for entry, body in zip([*entries, *shapes], [*bodies, *colliders]):
            put(self.path / str(entry["mesh"]), packed(**mesh_arrays(body.mesh)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass  # nothing is pending between frames


class Run(Sequence[StoredFrame]):
    """A stored run: ``run[i]`` reads frame i from the disk, ``len(run)`` counts the frames there were on opening.

    Attributes:
        path: The folder.
        name: Name of the problem.
        fps: Frames a second at which it is meant to be played.
        bodies: The bodies, each with its mesh at rest.
        colliders: What they could run into, each with its surface before any motion.
        info: When and by which version it was written, and what its writer was told to keep.

    Raises:
        InputError: The folder is missing or not a run, has no frames, or a file in it is missing or damaged.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        if not self.path.is_dir():
            raise InputError(f"no run at {self.path}: " + ("it is a file" if self.path.exists() else "no such folder"))
        manifest = reading(self.path / MANIFEST, _manifest)
        self._files = _in_order(self.path, _frame_files(self.path))
        if not self._files:
            raise InputError(f"{self.path} has no frames: its writer stopped before the first was finished")
        self.name: str = manifest["name"]
        self.fps: float = manifest["fps"]
        self.info: dict[str, Any] = {"pbng": manifest["pbng"], "created": manifest["created"], **manifest["info"]}
        self.bodies = tuple(
            StoredBody(b["name"], b["start"], b["stop"], reading(self.path / b["mesh"], read_mesh))
            for b in manifest["bodies"]
        )
        self.colliders = tuple(
            ColliderShape(c["name"], c["kind"], c["moves"], reading(self.path / c["mesh"], _surface))
            for c in manifest.get("colliders", ())  # older runs have none
        )

    def __len__(self) -> int:
        return len(self._files)

    @overload
    def __getitem__(self, i: int) -> StoredFrame: ...
    @overload
    def __getitem__(self, i: slice) -> list[StoredFrame]: ...
    def __getitem__(self, i: int | slice) -> StoredFrame | list[StoredFrame]:
        if isinstance(i, slice):
            return [self._read(file) for file in self._files[i]]
        return self._read(self._files[i])

    def _read(self, file: Path) -> StoredFrame:
        frame, moving = reading(file, _frame)
        points = tuple(moving.get(k, shape.mesh.X) for k, shape in enumerate(self.colliders))
        return replace(frame, colliders=points)

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r}: {len(self)} frames of {', '.join(body.name for body in self.bodies)})"


def solved(frames: Sequence[Any], moving: bool) -> Sequence[Any]:
    """Those of the frames of a run, or of what is known of each, that a solver made.

    With inertia, ``moving``, the first is the start, whose residual says nothing of how well the run was solved; if
    there is no other, it has to do.
    """
    return frames[1:] or frames if moving else frames


def read_run(path: str | os.PathLike[str]) -> Run:
    """Open a run that a :class:`FrameWriter` wrote, finished or not; raises what :class:`Run` raises."""
    return Run(path)


def _manifest(file: Path) -> dict[str, Any]:
    manifest = json.loads(file.read_text("utf-8"))
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise InputError(f"it does not say {FORMAT!r}")
    if manifest["version"] > FORMAT_VERSION:
        raise InputError(f"it was written by a newer pbng, {manifest['pbng']}")
    for key in ("pbng", "created", "name", "fps", "bodies", "info"):
        manifest[key]  # a KeyError names it
    return manifest


def _further(frame: Any) -> Iterator[tuple[str, np.ndarray]]:
    """What only some frames have."""
    for name in ("v", "springs"):
        if getattr(frame, name, None) is not None and len(getattr(frame, name)):
            yield name, np.asarray(getattr(frame, name))
    contact = getattr(frame, "contact", None)
    if contact is not None:
        for f in fields(StoredContact):
            yield _CONTACT + f.name, np.asarray(getattr(contact, f.name))
    for k, collider in enumerate(colliders_of(frame.problem)):
        if collider.motion is not None:
            yield f"collider_{k:03d}", collider.surface(frame.t)[0].astype(np.asarray(frame.x).dtype)


def _frame(file: Path) -> tuple[StoredFrame, dict[int, np.ndarray]]:
    """A frame, and the points of colliders that move."""
    values: dict[str, Any] = {name: a if a.ndim else a.item() for name, a in unpacked(file).items()}
    moving = {int(name[9:]): values.pop(name) for name in list(values) if re.fullmatch(r"collider_\d{3,}", name)}
    contact = {name[len(_CONTACT) :]: values.pop(name) for name in list(values) if name.startswith(_CONTACT)}
    return StoredFrame(**values, contact=StoredContact(**contact) if contact else None), moving


def _surface(file: Path) -> TriMesh:
    mesh = read_mesh(file)
    if not isinstance(mesh, TriMesh):
        raise InputError("it is not a surface")
    return mesh


def _require_same(path: Path, run: Run, bodies: Sequence[Any], colliders: Sequence[ColliderShape]) -> None:
    def same(stored: Sequence[Any], given: Sequence[Any], *names: str) -> bool:
        return len(stored) == len(given) and all(
            all(getattr(a, name) == getattr(b, name) for name in names)
            and np.array_equal(a.mesh.X, b.mesh.X)
            and np.array_equal(a.mesh.cells, b.mesh.cells)
            for a, b in zip(stored, given)
        )

    if not same(run.bodies, bodies, "name", "start", "stop"):
        raise InputError(f"cannot append to {path}: its bodies are not those of the frame")
    if not same(run.colliders, colliders, "name", "kind", "moves"):
        raise InputError(f"cannot append to {path}: its colliders are not those of the frame")


def _frame_files(path: Path) -> dict[int, Path]:
    return {int(match[1]): path / name for name in os.listdir(path) if (match := _FRAME.fullmatch(name))}


def _in_order(path: Path, files: dict[int, Path]) -> list[Path]:
    missing = sorted(set(range(len(files))) - set(files))
    if missing:
        raise InputError(f"incomplete run: {path / f'frame_{missing[0]:06d}.npz'} is missing")
    return [files[k] for k in sorted(files)]


def _is_run(path: Path) -> bool:
    try:
        return json.loads((path / MANIFEST).read_text("utf-8"))["format"] == FORMAT
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _is_temporary(name: str) -> bool:
    return name.startswith(".") and name.endswith(".tmp") and _OURS.fullmatch(name[1:-4]) is not None
