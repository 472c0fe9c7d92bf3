"""13. Contact: a ball of jelly is thrown at another, and a block slides down a slope.

``scene.contact()`` lets bodies touch each other, ``scene.collide_with`` keeps them out of planes, balls, boxes and
surfaces that move as told. Each frame reports what touched. Contacts are springs that push both sides alike, so that
momentum is kept; friction at a plane is Coulomb's.

Usage: python examples/13_contact.py
"""

import math

import pbng

JELLY = pbng.Corotated(E=2e4, nu=0.4, density=1000.0)  # Pa, -, kg/m³


def collide():
    """Momentum of both balls after they have met, over that before."""
    scene = pbng.Scene()
    ball = pbng.shapes.sphere(radius=0.1, vertices=7)
    thrown = scene.add(ball, JELLY, name="thrown", at=(-0.13, 0.02, 0.0))
    scene.add(ball, JELLY, name="waiting", at=(0.13, 0.0, 0.0))
    scene.contact()
    problem = scene.compile(free=True)
    velocity = 0.0 * problem.X
    velocity[: thrown.mesh.n_vert, 0] = 2.0  # m/s
    budget = pbng.Budget(rtol=1e-6, iterations=100)
    motion = {"inertia": True, "substeps": 2, "velocity": velocity}
    frames = list(pbng.simulate(problem, pbng.PBNG(), budget, frames=16, fps=60, **motion))
    most = max(frames, key=lambda frame: frame.contact.pairs)
    print(f"{most.contact.pairs} contacts at t = {most.t:.2f} s, the deepest {1e3 * most.contact.deepest:.2f} mm")
    for body in problem.bodies:
        part = slice(body.start, body.stop)
        print(f"{body.name}: {problem.mass[part] @ frames[-1].v[part, 0]:.2f} kg m/s at the end")
    return frames[-1].momentum[0] / frames[0].momentum[0]


def slide(friction=0.2, degrees=20.0):
    """Acceleration of a block on a slope over that of Coulomb's law."""
    slope = math.radians(degrees)
    down, into = 9.8 * math.sin(slope), 9.8 * math.cos(slope)  # m/s²: the scene is turned, and not the plane
    scene = pbng.Scene(gravity=(down, -into, 0.0))
    scene.add(pbng.shapes.box((0.2, 0.1, 0.2), (5, 3, 5)), pbng.Corotated(E=1e6, nu=0.3, density=1000.0))
    scene.collide_with(pbng.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), friction=friction))
    frames = list(pbng.simulate(scene, pbng.PBNG(), pbng.Budget(rtol=1e-5), frames=31, inertia=True))
    speed = [frame.momentum[0] / frame.problem.mass.sum() for frame in frames]
    return (speed[30] - speed[15]) / 0.5 / (down - friction * into)


def main(folder=None):
    """Returns what is left of the momentum or the block's acceleration over Coulomb's: the one farther from one."""
    kept, slid = collide(), slide()
    print(f"momentum: {kept:.6f} of it kept; acceleration on the slope: {slid:.4f} of Coulomb's")
    return max(kept, slid, key=lambda ratio: abs(ratio - 1))


if __name__ == "__main__":
    main()
