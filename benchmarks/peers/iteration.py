"""Seconds an iteration of XPBD of tets, pypbd's and pbng's, on one mesh: ``python iteration.py --n 16 32``.

An iteration projects every constraint once: in pypbd one a tet, of its Saint Venant-Kirchhoff energy, in float64; in
pbng two a tet, of the corotated model.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from environment import PeerError, check_python, make, output
from run import HERE, PEERS, THREADS
from scene import hard_start, save, smooth

import pbng
from pbng.bench.timing import machine

ROUNDS, STEPS = 15, 10


def own(n: int, dtype: str, threads: int) -> dict[str, Any]:
    """The row of pbng's XPBD."""
    problem = hard_start(n, "corotated")
    method = pbng.XPBD(dtype=dtype, iterations=None, threads=threads).set_up(problem)
    x, seconds = smooth(problem.X), []
    for k in range(ROUNDS + 1):
        method.start(x)
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in range(STEPS):
            method.step()
        if k:  # the first compiles
            seconds.append([(time.perf_counter() - wall) / STEPS, (time.process_time() - cpu) / STEPS])
    moved = float(np.abs(method.state() - x).max())
    return {"median": np.median(seconds, axis=0).tolist(), "best": np.min(seconds, axis=0).tolist(), "moved": moved}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0], prog="iteration.py")
    parser.add_argument("--n", type=int, nargs="+", default=[16, 32], help="vertices along an edge of the block")
    parser.add_argument("--threads", type=int, default=1, help="threads of both")
    parser.add_argument("--folder", type=Path, default=HERE / ".venvs", help="where the environment is made")
    parser.add_argument("--python", default=sys.executable, help="the Python it is made with")
    parser.add_argument("--record", type=Path, help="write what was measured to this JSON file")
    args = parser.parse_args()
    if min(args.n) < 3:
        raise PeerError(f"--n must be at least 3, not {min(args.n)}")
    os.environ |= {name: str(args.threads) for name in THREADS}  # for pypbd
    check_python(args.python)
    python, _ = make("pypbd", PEERS["pypbd"].requirements, args.folder.resolve(), args.python)

    rows = []
    with tempfile.TemporaryDirectory(prefix="peers_") as scratch:
        problem = Path(scratch) / "problem.npz"
        for n in args.n:
            load = os.getloadavg()[0]
            save(n, problem)
            said = output([str(python), str(HERE / "pypbd_iteration.py"), str(problem)], "pypbd failed")
            rows.append({"who": "pypbd, float64", "n": n, "load": load} | json.loads(said.splitlines()[-1]))
            for dtype in ("float32", "float64") if hasattr(pbng, "XPBD") else ():
                load = os.getloadavg()[0]
                rows.append({"who": f"pbng, {dtype}", "n": n, "load": load} | own(n, dtype, args.threads))
    show(rows, args.threads)
    if args.record is not None:
        report = {"benchmark": "xpbd iteration", "machine": machine(), "threads": args.threads, "rows": rows}
        args.record.parent.mkdir(parents=True, exist_ok=True)
        args.record.write_text(json.dumps(report, indent=1) + "\n")


def show(rows: list[dict[str, Any]], threads: int) -> None:
    """A table of the rows."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"One iteration of XPBD, all constraints once, ms, {threads} thread(s)")
    for heading in ("", "n", "median, CPU", "median, wall", "best, CPU", "best, wall", "load"):
        table.add_column(heading, justify="right" if heading else "left")
    for r in rows:
        times = [f"{1e3 * r[k][clock]:.2f}" for k in ("median", "best") for clock in (1, 0)]
        table.add_row(r["who"], str(r["n"]), *times, f"{r['load']:.1f}")
    Console(width=None if sys.stdout.isatty() else 120).print(table)


if __name__ == "__main__":
    try:
        main()
    except (PeerError, OSError) as error:
        sys.exit(f"iteration.py: {error}")
    except KeyboardInterrupt:
        sys.exit("iteration.py: interrupted")
