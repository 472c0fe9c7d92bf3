"""The problem of the comparison, by pbng: a block of n³ vertices, an end of which is turned and pulled in one step."""

from pathlib import Path

import numpy as np
from stvk import StVK

import pbng

MATERIALS = {"corotated": pbng.Corotated, "neo-hookean": pbng.NeoHookean, "stvk": StVK}
E, NU, DENSITY = 1e5, 0.3, 10.0  # Pa, -, kg/m³
LOADS = 64  # poses on the way, for peers that cannot take it in one step


def hard_start(n: int, material: str) -> pbng.Problem:
    """The unit block held at x = 0, its other end turned by 90° about x and moved by 0.5 m; at time 1, all of it.

    That is ``pbng.bench.scenes.hard_start``, but with poses on the way at the times from 0 to 1.
    """
    scene = pbng.Scene(name="hard start")
    block = scene.add(pbng.shapes.box(vertices=(n, n, n)), MATERIALS[material](E=E, nu=NU, density=DENSITY))
    scene.pin(block.where(x=0.0))
    scene.move(block.where(x=1.0), pbng.Rotate("x", turns=0.25) + pbng.Translate((0.5, 0, 0)), over=1.0)
    return scene.compile()


def smooth(X: np.ndarray) -> np.ndarray:
    """The unit block a little deformed, everywhere but at its ends, (v, 3) [m]."""
    return X + 0.02 * np.sin(np.pi * X[:, [1, 2, 0]]) * np.sin(np.pi * X[:, :1])


def save(n: int, path: Path) -> None:
    """Write what a driver needs to know.

    Rest positions X (v, 3) [m], cells (m, 4), ``fixed`` (v,) bool, lumped ``mass`` (v,) [kg], the start x0 (v, 3) [m],
    and the prescribed positions ``poses`` (LOADS + 1, n_fixed, 3) [m] in equal steps from rest to x0; E [Pa], nu,
    density [kg/m³]; and ``smooth`` (v, 3) [m], a state to time iterations at.
    """
    problem = hard_start(n, "corotated")
    np.savez(
        path,
        n=n,
        X=problem.X,
        cells=problem.groups[0].cells,
        fixed=problem.fixed,
        mass=problem.mass,
        x0=problem.constrain(problem.X, 1.0),
        smooth=smooth(problem.X),
        poses=np.stack([problem.prescribed(k / LOADS) for k in range(LOADS + 1)]),
        E=E,
        nu=NU,
        density=DENSITY,
    )
