"""4. A material of one's own, checked and used.

A rubber that stiffens as it is drawn out, like Yeoh's. With y = |F|² - 3:

    Ψ = μ/2 y + c h(y) - μ (J - 1) + k/2 (J - 1)²,   h(y) = 2 Y² (sqrt(1 + y²/Y²) - 1)

h is y² for small y, Yeoh's term, and becomes straight for large y, so that a block can majorise Ψ everywhere;
docs/materials.md derives all of it.
"""

import math

import numpy as np
from scipy.optimize import brentq

import pbng
from pbng.linalg import cofactor, det, mat_combine, norm2


@pbng.material
class Stiffening(pbng.Material):
    """Energy and stress as functions of F and the numbers of ``parameters``; plus the two numbers of the block."""

    c: float = 0.0  # Pa
    Y: float = 3.0

    def energy(F, mu, c, k, Y):
        real = type(mu)
        y, dJ = norm2(F) - real(3), det(F) - real(1)
        root = math.sqrt(real(1) + y * y / (Y * Y))
        return real(0.5) * mu * y + real(2) * c * y * y / (root + real(1)) + (real(0.5) * k * dJ - mu) * dJ

    def stress(F, mu, c, k, Y):
        real = type(mu)
        y = norm2(F) - real(3)
        root = math.sqrt(real(1) + y * y / (Y * Y))
        return mat_combine(mu + real(4) * c * y / root, F, k * (det(F) - real(1)) - mu, cofactor(F))

    def parameters(self):
        return self.mu, self.c, self.lam + self.mu - 8 * self.c, self.Y

    def block(self):
        return pbng.Block(a=self.mu + (24 + 7.1 * self.Y) * self.c, b=self.lam + self.mu - 8 * self.c)


def main(folder=None, vertices=5):
    """Returns the force that draws a bar of it to 1.6 of its length, over the force of the formula."""
    rubber, stretch = Stiffening(E=1e5, nu=0.4, c=1e4), 1.6
    report = pbng.check_material(rubber)
    print(report)
    assert report.ok

    def P(across):  # the stress under diag(stretch, across, across)
        f, J = np.array([stretch, across, across]), stretch * across**2
        mu, c, k, Y = rubber.parameters()
        y = f @ f - 3
        return (mu + 4 * c * y / math.sqrt(1 + (y / Y) ** 2)) * f + (k * (J - 1) - mu) * J / f

    across = brentq(lambda a: P(a)[1], 0.5, 1.0)  # no stress across
    scene = pbng.Scene()
    bar = scene.add(pbng.shapes.beam(2.0, 1.0, vertices), rubber)
    for end in (bar.where(x=0.0), bar.where(x=2.0)):
        scene.move(end, lambda t, X: X * [stretch, across, across])
    problem = scene.compile()
    result = pbng.solve(problem, budget=pbng.Budget(rtol=1e-5))
    pull = -problem.forces(result.x)[bar.where(x=2.0).index, 0].sum()
    print(f"{result.iterations} sweeps; force {pull:.1f} N, by the formula {P(across)[0]:.1f} N")
    return float(pull / P(across)[0])


if __name__ == "__main__":
    print(f"force / formula = {main():.5f}")
