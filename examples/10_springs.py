"""10. Bodies bound together: a bar of muscle between two blocks, by springs much stiffer than the flesh.

Each end vertex of the bar is tied to the closest point of the block beside it. The springs have no length: they close
the gap of 0.1 m, and what then pulls at one wall pulls at the other.

Usage: python examples/10_springs.py
"""

import numpy as np

import pbng


def main(folder=None):
    """Returns the force along x at the left wall over that at the right one, which balances it."""
    flesh = pbng.Corotated(E=1e3, nu=0.3, density=10.0)  # Pa, -, kg/m³
    block = pbng.shapes.box(size=(0.5, 1.0, 1.0), vertices=(5, 8, 8))
    bar = pbng.shapes.box(size=(1.8, 0.5, 0.5), vertices=(15, 5, 5))

    scene = pbng.Scene(gravity=(0.0, -9.8, 0.0))
    left = scene.add(block, flesh, name="left")
    right = scene.add(block, flesh, name="right", at=(2.5, 0.0, 0.0))
    muscle = scene.add(bar, flesh, name="muscle", at=(0.6, 0.25, 0.25))
    walls = left.where(x=0.0), right.where(x=3.0)
    for wall in walls:
        scene.pin(wall)
    scene.bind(muscle.where(x=0.6), left, k=1e6)  # N/m
    scene.bind(muscle.where(x=2.4), right, k=1e6)

    problem = scene.compile()
    result = pbng.solve(problem, budget=pbng.Budget(error=1e-4))
    gaps = np.linalg.norm(problem.weak_energy.gaps(result.x, np.empty((0, 3))), axis=1)
    print(f"{result.iterations} cycles: {result.status} Largest gap left: {gaps.max():.1e} m")
    forces = problem.forces(result.x)
    pulls = [abs(forces[wall.index, 0].sum()) for wall in walls]
    print(f"the muscle pulls with {pulls[0]:.2f} N")
    return pulls[0] / pulls[1]


if __name__ == "__main__":
    print(f"left / right = {main():.4f}")
