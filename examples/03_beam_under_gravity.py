"""3. A beam under gravity against beam theory.

A beam, clamped at one end, sags under its weight by so little that linear theory holds. Linear tets are too stiff in
bending, by an error that falls as h²: two meshes, and the limit drawn from them, show both.
"""

import pbng

LENGTH, WIDTH, E, DENSITY, GRAVITY = 4.0, 1.0, 1e6, 1000.0, 0.05  # m, m, Pa, kg/m³, m/s²


def sag(vertices):
    """Mean sag [m] of the free end."""
    mesh = pbng.shapes.beam(LENGTH, WIDTH, vertices)
    scene = pbng.Scene(gravity=(0.0, -GRAVITY, 0.0))
    beam = scene.add(mesh, pbng.Corotated(E=E, nu=0.0, density=DENSITY))
    scene.pin(beam.where(x=0.0))
    solver = pbng.PBNG(pbng.Anderson(memory=20), dtype="float64")  # many sweeps, fewer with a long memory
    result = pbng.solve(scene, solver, pbng.Budget(rtol=1e-4))
    print(f"{mesh.n_vert} vertices, {result.iterations} sweeps")
    end = beam.where(x=LENGTH).index
    return float((mesh.X - result.x)[end, 1].mean())


def main(folder=None, vertices=5):
    """Returns the sag, extrapolated to a fine mesh, over that of beam theory."""
    load, inertia, shear_area = DENSITY * GRAVITY * WIDTH**2, WIDTH**4 / 12, 5 / 6 * WIDTH**2
    theory = load * LENGTH**4 / (8 * E * inertia) + load * LENGTH**2 / (2 * shear_area * E / 2)  # Timoshenko, G = E/2
    coarse, fine = sag(vertices), sag(2 * vertices - 1)
    limit = fine + (fine - coarse) / 3
    for name, value in (("coarse", coarse), ("fine", fine), ("limit", limit), ("theory", theory)):
        print(f"{name:<7} {value * 1e3:7.3f} mm")
    return limit / theory


if __name__ == "__main__":
    print(f"sag / theory = {main():.4f}")
