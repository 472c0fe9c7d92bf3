"""9. Labels to trust: poses of a bar, each within a given distance of its equilibrium.

A residual says how well forces balance, not how far the shape is from where it belongs. Asked for an error in metres,
`solve` takes the two-grid method, which estimates that distance, and goes on until it is small enough. Here each pose
is then checked against a reference.
"""

import numpy as np

import pbng


def pose(number, rng, vertices):
    """A bar whose right end is turned, bent and drawn out at random."""
    scene = pbng.Scene(name=f"pose {number}")
    bar = scene.add(
        pbng.shapes.box((2.0, 1.0, 1.0), (2 * vertices - 1, vertices, vertices)), pbng.NeoHookean(E=1e5, nu=0.4)
    )
    scene.pin(bar.where(x=0.0))
    twist, bend, stretch = rng.uniform(-0.2, 0.2), rng.uniform(-0.1, 0.1), rng.uniform(0.0, 0.5)
    scene.move(bar.where(x=2.0), pbng.Rotate("x", twist) + pbng.Rotate("z", bend) + pbng.Translate((stretch, 0.0, 0.0)))
    return scene.compile()


def main(folder=None, count=5, vertices=7):
    """Returns the part of the poses whose true error is below what was asked for."""
    error, good = 1e-3, 0  # m
    rng = np.random.default_rng(1)
    for number in range(count):
        problem = pose(number, rng, vertices)
        result = pbng.solve(problem, budget=pbng.Budget(error=error))
        reference = pbng.solve(problem, budget=pbng.Budget(rtol=1e-10))  # finishes in float64
        true = np.linalg.norm(result.x - reference.x, axis=1).max()
        good += true <= error
        print(
            f"pose {number}: {result.iterations} cycles, {result.seconds * 1e3:.0f} ms,"
            f" estimated error {result.error:.1e} m, true {true:.1e} m, {result.inverted} inverted"
        )
    return good / count


if __name__ == "__main__":
    print(f"{main():.0%} of the poses are as good as asked for")
