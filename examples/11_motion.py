"""11. Motion: a bar at a wall falls and swings, and a spinning ball of jelly is thrown.

Backward Euler, four steps a frame. It is robust at any time step, and damps: the energy never rises. Free bodies keep
their momentum.

Usage: python examples/11_motion.py
"""

import numpy as np

import pbng


def main(folder=None):
    """Returns the momentum of the ball at the end over that at the start."""
    rubber = pbng.Corotated(E=2e4, nu=0.4, density=1000.0)  # Pa, -, kg/m³

    scene = pbng.Scene(gravity=(0.0, -9.8, 0.0))
    bar = scene.add(pbng.shapes.beam(length=0.5, width=0.1, vertices=4), rubber, name="bar")
    scene.pin(bar.where(x=0.0))
    for frame in pbng.simulate(scene, frames=10, fps=30, inertia=True, substeps=4):
        parts = frame.kinetic_energy, frame.potential_energy
        print(f"t = {frame.t:.2f} s: kinetic {parts[0]:.3f} J, potential {parts[1]:7.3f} J, sum {sum(parts):.3f} J")

    thrown = pbng.Scene()
    ball = thrown.add(pbng.shapes.sphere(radius=0.1, vertices=6), rubber, name="ball")
    velocity = np.array([2.0, 0.0, 0.0]) + np.cross([0.0, 0.0, 20.0], ball.mesh.X)  # m/s
    first, *_, last = pbng.simulate(thrown, frames=6, fps=30, inertia=True, substeps=4, velocity=velocity)
    print(f"thrown with {first.momentum[0]:.3f} kg m/s, flies with {last.momentum[0]:.3f} kg m/s")
    return last.momentum[0] / first.momentum[0]


if __name__ == "__main__":
    print(f"end / start = {main():.6f}")
