"""Time of one sweep, beside a reference implementation and the paper's figures."""

import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numba
import numpy as np

from pbng.bench.scenes import box, delaunay, hard_start, model_of
from pbng.bench.timing import interleaved, peak_memory
from pbng.errors import InputError
from pbng.packing import pack_problem
from pbng.problem import Problem
from pbng.solvers.threads import check_threads
from pbng.sweep import sweep

PAPER_NS = {32: 187, 64: 52}  # ns a tet and iteration on 8 threads of a Threadripper 3995WX (Table 1)
MESHES = {"box": box, "delaunay": delaunay}
Row = dict[str, Any]


def measure(
    cases: list[tuple[str, int]], models: list[str], threads: list[int], dtype: str, rounds: int, reference: Path | None
) -> list[Row]:
    """One row a mesh, model and number of threads; ``reference`` is the folder of an implementation to run against."""
    rows = []
    for count in threads:
        check_threads("bench sweep", count)
    materials = {model: model_of(model)(E=1e5, nu=0.3, density=10.0) for model in models}
    for kind, n in cases:
        mesh = MESHES[kind](n)
        for model, material in materials.items():
            problem = hard_start(mesh, material)
            start = time.perf_counter()
            packed = pack_problem(problem, np.dtype(dtype))
            first = time.perf_counter() - start  # holds compilation
            setup = _setup_seconds(problem, dtype)
            x = packed.pack(problem.X)
            colors = np.tile(np.arange(packed.n_color), 5)
            for count in threads:
                numba.set_num_threads(count)
                contestants: dict[str, Callable[[], Any]] = {"pbng": partial(sweep, packed, x, colors)}
                if reference is not None:
                    contestants["reference"] = _reference(reference, problem, model, np.dtype(dtype))
                seconds = {k: s / 5 for k, s in interleaved(contestants, rounds).items()}
                row = {
                    "mesh": f"{kind} {n}",
                    "tets": problem.n_elem,
                    "model": model,
                    "threads": count,
                    "ms": float(np.median(seconds["pbng"]) * 1e3),
                    "best_ms": float(seconds["pbng"].min() * 1e3),
                    "ns_per_tet": float(np.median(seconds["pbng"]) / problem.n_elem * 1e9),
                    "paper_ns": PAPER_NS.get(n) if kind == "box" else None,
                    "setup_s": min(first, setup),
                    "layout_MB": packed.nbytes / 1e6,
                    "peak_MB": peak_memory() / 1e6,
                }
                if reference is not None:
                    row["ratio"] = float(np.median(seconds["pbng"] / seconds["reference"]))
                    row["best_ratio"] = float(seconds["pbng"].min() / seconds["reference"].min())
                rows.append(row)
    return rows


def _setup_seconds(problem: Problem, dtype: str) -> float:
    """Seconds [s] of colouring and packing, compiled."""
    fresh = Problem(
        problem.name, problem.X, problem.groups, problem.bodies, problem.fixed, problem.prescribed, problem.f_ext,
        problem.mass, problem.end,
    )  # fmt: skip
    start = time.perf_counter()
    pack_problem(fresh, np.dtype(dtype))
    return time.perf_counter() - start


def _reference(folder: Path, problem: Problem, model: str, dtype: np.dtype) -> Callable[[], Any]:
    """A call of five sweeps of the implementation in ``folder`` (modules ``common`` and ``pbng_numba``)."""
    if not (folder / "pbng_numba.py").is_file():
        raise InputError(f"{folder} holds no pbng_numba.py to compare with")
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    import common
    import pbng_numba

    runs = {"corotated": pbng_numba.run_fc, "neo-hookean": pbng_numba.run_nh}
    if model not in runs:
        raise InputError(f"the reference has no {model}; it has {sorted(runs)}")
    (group,) = problem.groups
    prepared = common.prep(problem.X, group.cells, g=0)
    layout = common.sell(prepared, 16, dtype=dtype.type)
    arrays = [np.ascontiguousarray(layout[k]).ravel() for k in ("cstart", "row", "idx", "cf", "nodal")]
    x = common.to_slots(layout, problem.X, dtype.type).ravel()
    ratio = dtype.type(prepared["lam"] / (2 * prepared["mu"]))
    return lambda: runs[model](x, *arrays, ratio, 5, dtype.type(1))
