"""8. Accelerations compared: one problem, one residual, five ways. Needs pbng[view] for the plot.

SOR and Chebyshev are as the paper prints them; on harder problems they may diverge. docs/method.md says why the others
cannot.

Usage: python examples/08_accelerations.py [folder]
"""

import sys
import tempfile
from pathlib import Path

import pbng

WAYS = {
    "plain": None,
    "node SOR": pbng.NodeSOR(1.7),
    "SOR": pbng.SOR(),
    "Chebyshev": pbng.Chebyshev(),
    "Anderson": pbng.Anderson(),  # the default
}


def main(folder=None, vertices=10):
    """Returns the sweeps that plain PBNG takes to a residual of a thousandth, over those of Anderson's method."""
    folder = Path(folder or tempfile.mkdtemp(prefix="pbng-"))
    scene = pbng.Scene()
    block = scene.add(pbng.shapes.box(vertices=vertices), pbng.Corotated(E=1e5, nu=0.3))
    scene.pin(block.where(x=0.0))
    scene.move(block.where(x=1.0), pbng.Rotate("x", turns=0.25) + pbng.Translate((0.5, 0.0, 0.0)))
    problem = scene.compile()

    sweeps, curves = {}, {}
    for name, way in WAYS.items():
        result = pbng.solve(problem, pbng.PBNG(way), pbng.Budget(rtol=1e-3, iterations=2000, every=2))
        sweeps[name] = result.iterations
        curves[name] = result.monitored, result.residuals / result.residuals[0]
        print(f"{name:<10} {result.iterations:5d} sweeps, {result.seconds:6.3f} s, {result.status}")
    print("plot:", pbng.view.plot_residuals(curves, folder / "residuals.png", xlabel="sweeps", ylabel="residual ratio"))
    return sweeps["plain"] / sweeps["Anderson"]


if __name__ == "__main__":
    print(f"plain / Anderson = {main(*sys.argv[1:]):.1f}")
