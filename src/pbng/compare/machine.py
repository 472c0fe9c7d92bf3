"""What numbers were measured on, and with which versions."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numba
import numpy as np

from pbng import __version__

PACKAGES = ("numpy", "scipy", "numba", "llvmlite")


def machine() -> dict[str, Any]:
    """What the numbers were measured on."""
    model = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as info:
            model = next(line.split(":")[1].strip() for line in info if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
    }


def versions() -> dict[str, str | None]:
    """Versions of pbng, Python and the packages that results depend on."""
    return {"pbng": __version__, "python": platform.python_version()} | {name: _version(name) for name in PACKAGES}


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
