"""12. Cloth: a sheet whose two ends are brought together hangs in a catenary.

Triangles with a membrane are cloth; how it resists bending is told apart, by a stiffness of the edges between them. The
sag is compared with that of a chain of the same length. Newton's method finds the equilibrium; sweeps alone let cloth
sink slowly, and are at their best in motion, with inertia.

Usage: python examples/12_cloth.py
"""

import math

import pbng


def main(folder=None, vertices=25):
    """Returns the sag of the sheet over that of a chain."""
    length, span, width = 1.0, 0.8, 0.25
    cotton = pbng.Membrane(E=5e3, nu=0.2, density=0.15)  # N/m, -, kg/m²
    scene = pbng.Scene(gravity=(0.0, -9.8, 0.0))
    sheet = pbng.shapes.sheet((length, width), (vertices, vertices // 4 + 1))
    cloth = scene.add(sheet, cotton, pbng.Bending(k=1e-5, weighted=True), name="cloth")  # N m
    scene.pin(cloth.where(x=0.0))
    scene.move(cloth.where(x=length), pbng.Translate((span - length, 0.0, 0.0)))

    result = pbng.solve(scene, pbng.Newton(), pbng.Budget(rtol=1e-6, iterations=200))
    sag = -result.x[:, 1].min()

    low, high = 1e-3, 10.0  # half the span over the catenary's parameter, c sinh(span / 2c) = length / 2
    for _ in range(60):
        u = (low + high) / 2
        low, high = (u, high) if math.sinh(u) / u < length / span else (low, u)
    chain = span / (2 * u) * (math.cosh(u) - 1)
    print(f"{result.iterations} Newton steps; the cloth sags by {sag:.4f} m, a chain by {chain:.4f} m")
    return float(sag / chain)


if __name__ == "__main__":
    print(f"sag / theory = {main():.4f}")
