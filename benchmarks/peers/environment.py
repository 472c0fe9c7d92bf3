"""Throw-away environments: one a peer, in a folder of its own."""

import json
import os
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path


class PeerError(Exception):
    """What went wrong, in one line."""


def make(name: str, requirements: Sequence[str], folder: Path, python: str) -> tuple[Path, dict[str, float]]:
    """Install packages into ``folder/name``, unless they are there already.

    Returns the interpreter, and the ``seconds`` and ``MB`` that the installation took.
    """
    home = folder / name
    done, wanted = home / "installed.json", list(requirements)
    own = home / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if done.is_file() and own.exists():
        was = json.loads(done.read_text())
        if was["requirements"] == wanted:
            return own, was["took"]
    print(f"{name}: installing {' '.join(wanted)} into {home}", flush=True)
    start = time.perf_counter()
    output([python, "-m", "venv", "--clear", str(home)], f"cannot make an environment in {home} with {python}")
    pip = [str(own), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    output([*pip, "--only-binary", ":all:", *wanted], f"cannot install {' '.join(wanted)}")
    size = sum(f.stat().st_size for f in home.rglob("*") if f.is_file() and not f.is_symlink())
    took = {"seconds": round(time.perf_counter() - start), "MB": round(size / 1e6)}
    done.write_text(json.dumps({"requirements": wanted, "took": took}))
    print(f"{name}: took {took['seconds']} s and {took['MB']} MB", flush=True)
    return own, took


def check_python(python: str) -> None:
    """PeerError if there is no such interpreter, or it is older than 3.11."""
    code = "import sys; print(sys.version_info >= (3, 11))"
    if output([python, "-c", code], f"cannot run {python}").strip() != "True":
        raise PeerError(f"{python} is older than Python 3.11")


def output(command: list[str], complaint: str) -> str:
    """Output of a command; if it fails, PeerError with the last of what it said that tells why."""
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}
    try:
        ran = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    except OSError as error:
        raise PeerError(f"{complaint}: {error.strerror}") from error
    if ran.returncode:
        said = [line for line in (ran.stderr + ran.stdout).splitlines() if line.strip()]
        errors = [line for line in said if "error" in line.lower()] or said or [f"exit status {ran.returncode}"]
        raise PeerError(f"{complaint}: {errors[-1].strip()}")
    return ran.stdout
