"""What ``pbng info`` tells of meshes and runs."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pbng.errors import InputError
from pbng.io.frames import read_run, solved
from pbng.io.meshes import MESHES, SURFACES, read_mesh, read_surface
from pbng.mesh_quality import quality

Rows = Iterator[tuple[str, str]]


def mesh_rows(file: Path) -> Rows:
    """Quality of the mesh in a file."""
    suffix = file.suffix.lower()
    if not file.exists():
        raise InputError(f"no file or folder {file}")
    if suffix not in MESHES + SURFACES:
        raise InputError(f"{file}: expected a mesh ({' '.join(MESHES + SURFACES)}) or the folder of a run")
    mesh = read_mesh(file) if suffix in MESHES else read_surface(file)
    yield from quality(mesh).rows()
    for what, groups in (("vertex groups", mesh.groups), ("cell groups", mesh.cell_groups)):
        if groups:
            yield what, ", ".join(f"{name} ({len(members):,})" for name, members in groups.items())


def run_rows(folder: Path) -> Rows:
    """What a run holds, and how well its frames were solved."""
    run = read_run(folder)
    frames = list(run)
    yield "scene", run.name
    yield "frames", f"{len(frames)}, {run.fps:g} a second, t = {frames[0].t:g} to {frames[-1].t:g} s"
    for body in run.bodies:
        cells = f"{body.mesh.n_elem:,} {body.mesh.cell_name}s"
        yield f"body {body.name}", f"{body.mesh.n_vert:,} vertices, {cells}"
    frames = list(solved(frames, frames[0].v is not None))
    yield "ended", ", ".join(f"{n} {status.lower()}" for status, n in Counter(f.status for f in frames).items())
    iterations = sum(f.iterations for f in frames)
    yield "iterations", f"{iterations:,}, {iterations / len(frames):.0f} a frame"
    ends = [f.residuals[-1] for f in frames if len(f.residuals)]
    if ends:
        yield "residual, end", f"median {np.median(ends):.2e} N, worst {max(ends):.2e} N"
    yield "inverted elements", f"{frames[-1].inverted:,} at the end, at most {max(f.inverted for f in frames):,}"
    for key, value in run.info.items():
        yield key, str(value)
