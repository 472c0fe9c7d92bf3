"""Measure peers of pbng on one problem, by pbng's residual: ``python run.py mujoco newton --n 16``.

Each peer gets an environment of its own, runs in a process of its own and is judged by the float64 residual of the
material that it solves. pbng runs in the same session, on the same clock. See README.md beside this file.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from environment import PeerError, check_python, make

try:
    import numpy as np
    from record import MARK
    from scene import hard_start, save

    from pbng.bench.timing import machine
except ImportError as error:
    sys.exit(f"{Path(sys.argv[0]).name}: pbng must be installed in {sys.executable}: {error}")

HERE = Path(__file__).parent
MARKS = (1e-2, 1e-3, 1e-6)
THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
MOVED = 1e-5  # how far prescribed vertices may be from their places [m]
PATIENCE = 10.0  # CPU seconds [s] after which a peer is given up that has gained less than GAIN in the latter half
GAIN = 0.9


@dataclass(frozen=True)
class Peer:
    """What it is called, what runs it, the material it solves, and what is installed for it (nothing for pbng)."""

    title: str
    driver: str
    material: str
    requirements: tuple[str, ...] = ()
    options: tuple[str, ...] = ()


PEERS = {
    "mujoco": Peer("MuJoCo flex, discrete", "mujoco_flex.py", "stvk", ("mujoco==4.0.0",)),
    "newton": Peer("Newton SolverVBD", "newton_vbd.py", "neo-hookean", ("newton==1.8.0", "warp-lang==1.19.0")),
    "pypbd": Peer("pypbd XPBD", "pypbd_xpbd.py", "stvk", ("pypbd==2.2.2", "numpy>=2")),
    "skfem": Peer(
        "scikit-fem + Pardiso", "skfem_pardiso.py", "neo-hookean", ("scikit-fem==12.0.2", "pypardiso==0.4.7")
    ),
}
OWN = {"two-grid": "pbng, two-grid", "anderson": "pbng, Anderson"}


class Judge:
    """The residuals of the states that drivers hand over."""

    def __init__(self, n: int, material: str) -> None:
        self.problem = hard_start(n, material)
        self.x0 = self.problem.constrain(self.problem.X, 1.0)
        self.first = self.problem.residual(self.x0)
        self.yardstick = hard_start(n, "corotated").residual(self.x0)
        self.goal = MARKS[-1] * min(self.first, self.yardstick)
        self.history: list[dict[str, float]] = []

    def look(self, moment: dict[str, float], x: np.ndarray) -> bool:
        """Take down a state; whether to go on."""
        fixed = self.problem.fixed
        off = float(np.abs(x - self.x0)[fixed].max())
        if off > MOVED:
            raise PeerError(f"prescribed vertices are {off:.1e} m from their places")
        residual = self.problem.residual(x) if np.isfinite(x).all() else math.nan
        self.history.append(moment | {"residual": residual})
        self.last = x
        return residual > self.goal and not self.stalled()

    def stalled(self) -> bool:
        """Whether the residual has ceased to fall."""
        now = self.history[-1]["cpu"]
        early = [m["residual"] for m in self.history if m["cpu"] <= now / 2]
        late = [m["residual"] for m in self.history if m["cpu"] > now / 2]
        return now > PATIENCE and bool(early) and min(late) > GAIN * min(early)

    def verdict(self) -> dict[str, Any]:
        """First residuals [N], the history by columns, and energy [J] and inverted tets at its end."""
        finite = np.isfinite(self.last).all()
        columns = {k: [float(f"{m[k]:.5g}") for m in self.history] for k in ("wall", "cpu", "residual")}
        return {
            "first": self.first,
            "first_corotated": self.yardstick,
            "energy": self.problem.energy(self.last) if finite else None,
            "inverted": self.problem.inverted(self.last) if finite else None,
            "iteration": [m["iteration"] for m in self.history],
            **columns,
        }


def measure(title: str, command: list[str], n: int, material: str, threads: int, limit: float) -> dict[str, Any]:
    """Run a driver, judge what it hands over, and return a row: who, what it took, and its history.

    The driver is ended after ``limit`` seconds [s] by the wall, set-up included; what it has done until then counts.
    """
    judge, said = Judge(n, material), {}
    start, before, ended = time.perf_counter(), os.getloadavg()[0], False
    environment = os.environ | {name: str(threads) for name in THREADS}
    with tempfile.TemporaryFile("w+") as errors:
        # In the folder of the problem, which is thrown away: MuJoCo leaves a log where it runs.
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True, env=environment,
            cwd=Path(command[2]).parent,
        )  # fmt: skip

        def end() -> None:
            nonlocal ended
            ended = True
            process.kill()

        timer = threading.Timer(limit, end)
        timer.start()
        try:
            x = Path(command[2]).with_name("x.npy")
            for line in process.stdout:
                if not line.startswith(MARK):
                    continue
                what = json.loads(line.removeprefix(MARK))
                if "versions" in what:
                    said = what
                    continue
                go = judge.look(what, np.load(x))
                process.stdin.write("go\n" if go else "stop\n")
                process.stdin.flush()
                if sys.stdout.isatty():
                    print(f"\r{title}: {what['cpu']:.2f} s, {judge.history[-1]['residual']:.2e} N ", end="", flush=True)
            process.wait()
        except BrokenPipeError:  # it ended while it was judged; its status says why
            process.wait()
        finally:
            timer.cancel()
            process.kill()
        print(f"\r{title}: {time.perf_counter() - start:.0f} s in all, judging and starting included", flush=True)
        errors.seek(0)
        last = [line for line in errors.read().splitlines() if line.strip()][-1:]
    if process.returncode and not ended:
        raise PeerError(f"its driver failed: {last[0] if last else f'exit status {process.returncode}'}")
    if not judge.history:
        raise PeerError(f"no state within {limit:g} s")
    row = {"peer": title, "n": n, "material": material, "threads": threads, "ended_by_limit": ended}
    return row | {"load_average": [before, os.getloadavg()[0]]} | said | judge.verdict()


def seconds_to(row: dict[str, Any], mark: float, clock: str, absolute: bool = False) -> float | None:
    """When the residual was first found below a fraction of the first one, or of that of corotated; None if never."""
    level = mark * row["first_corotated" if absolute else "first"]
    return next((t for t, residual in zip(row[clock], row["residual"]) if residual <= level), None)


def show(rows: list[dict[str, Any]], clock: str) -> None:
    """A table of the rows, the materials apart."""
    from rich.console import Console
    from rich.table import Table

    def number(value: float | None) -> str:
        return "-" if value is None else f"{value:.3g}"

    console = Console(width=None if sys.stdout.isatty() or "COLUMNS" in os.environ else 170)
    for n, material in dict.fromkeys((r["n"], r["material"]) for r in rows):
        mine = [r for r in rows if (r["n"], r["material"]) == (n, material)]
        stvk = material == "stvk"
        table = Table(title=f"{n}³ vertices, {material}: {clock} seconds to a residual")
        for heading in ("", "set-up", "ms/it.", *(f"{m:.0e}" for m in MARKS)):
            table.add_column(heading, justify="right" if heading else "left")
        for heading in [f"{m:.0e} of corotated" for m in MARKS] if stvk else []:
            table.add_column(heading, justify="right")
        for heading in ("last", "wall/CPU", "load", "MB"):
            table.add_column(heading, justify="right")
        for r in mine:
            wall, cpu = r["wall"][-1], r["cpu"][-1]
            cells = [r["peer"], number(r.get("set-up", {}).get(clock))]
            cells.append(number(1e3 * r[clock][-1] / max(r["iteration"][-1], 1)))
            cells += [number(seconds_to(r, m, clock)) for m in MARKS]
            cells += [number(seconds_to(r, m, clock, absolute=True)) for m in MARKS] if stvk else []
            cells.append(f"{r['residual'][-1] / r['first']:.1e}")
            cells += [number(wall / cpu if cpu else None), f"{max(r['load_average']):.1f}"]
            table.add_row(*cells, f"{r['peak_MB']:.0f}" if "peak_MB" in r else "-")
        console.print(table)


def options() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0], prog="run.py")
    parser.add_argument("peers", nargs="*", metavar="PEER", help=f"of {', '.join(PEERS)}; by default all")
    parser.add_argument("--n", type=int, default=16, help="vertices along an edge of the block")
    parser.add_argument("--seconds", type=float, default=120.0, help="CPU seconds of solving, at most [s]")
    parser.add_argument("--limit", type=float, default=600.0, help="wall seconds of a driver, at most [s]")
    parser.add_argument("--threads", type=int, default=1, help="threads of what can use several")
    parser.add_argument("--clock", choices=("cpu", "wall"), default="cpu", help="which seconds the table shows")
    parser.add_argument("--folder", type=Path, default=HERE / ".venvs", help="where the environments are made")
    parser.add_argument("--python", default=sys.executable, help="the Python they are made with")
    parser.add_argument("--record", type=Path, help="write what was measured to this JSON file")
    return parser.parse_args()


def main() -> None:
    args = options()
    names = args.peers or list(PEERS)
    for name in names:
        if name not in PEERS:
            raise PeerError(f"unknown peer {name!r}: expected one of {', '.join(PEERS)}")
    if args.n < 3:
        raise PeerError(f"--n must be at least 3, not {args.n}")
    check_python(args.python)
    if args.record is not None:
        args.record.parent.mkdir(parents=True, exist_ok=True)

    rows: list[dict[str, Any]] = []
    failed = []
    with tempfile.TemporaryDirectory(prefix="peers_") as scratch:
        problem = Path(scratch) / "problem.npz"
        save(args.n, problem)
        rest = [str(problem), str(args.seconds)]
        for name in names:
            peer = PEERS[name]
            try:
                python, took = make(name, peer.requirements, args.folder.resolve(), args.python)
                command = [str(python), str(HERE / peer.driver), *rest]
                row = measure(peer.title, command, args.n, peer.material, args.threads, args.limit)
                rows.append(row | {"installation": took})
            except PeerError as error:
                failed.append(name)
                print(f"run.py: {name}: {error}", file=sys.stderr)
        for material in dict.fromkeys(PEERS[name].material for name in names if name not in failed):
            for solver, title in OWN.items():
                command = [sys.executable, str(HERE / "pbng_self.py"), *rest, solver, material]
                rows.append(measure(title, command, args.n, material, args.threads, args.limit))
    if rows:
        show(rows, args.clock)
    if args.record is not None and rows:
        args.record.write_text(as_text({"benchmark": "peers", "machine": machine(), "rows": rows}))
    if failed:
        sys.exit(1)


def as_text(report: dict[str, Any]) -> str:
    """JSON with a line for each row."""
    head = json.dumps({k: v for k, v in report.items() if k != "rows"})
    return head[:-1] + ', "rows": [\n' + ",\n".join(json.dumps(row) for row in report["rows"]) + "\n]}\n"


if __name__ == "__main__":
    try:
        main()
    except (PeerError, OSError) as error:
        sys.exit(f"run.py: {error}")
    except KeyboardInterrupt:
        sys.exit("run.py: interrupted")
