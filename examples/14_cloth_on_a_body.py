"""14. Cloth on a body: a blanket falls on a little dragon, which then turns round.

The dragon is a kinematic body: a surface that moves as told, and that the cloth stays out of by the thickness. The
cloth collides with itself, too.

Usage: python examples/14_cloth_on_a_body.py
"""

import pbng


def main(folder=None, vertices=28, frames=46):
    """Returns how near the cloth comes to the dragon, over the thickness."""
    dragon = pbng.Kinematic(
        pbng.creature(), motion=pbng.Rotate("y", turns=0.25), start=0.8, over=0.7, thickness=0.012, friction=0.4
    )
    scene = pbng.Scene(gravity=(0.0, -9.8, 0.0))
    blanket = pbng.shapes.sheet((1.2, 0.9), (vertices, 3 * vertices // 4), (-0.6, 0.9, -0.45))
    scene.add(blanket, pbng.Membrane(E=500.0, nu=0.3, density=0.2), pbng.Bending(k=1e-4, weighted=True), name="blanket")
    scene.collide_with(dragon)
    scene.contact(self_collision=True, thickness=0.012)

    nearest = 1.0
    moving = pbng.simulate(scene, pbng.PBNG(), pbng.Budget(iterations=40), frames=frames, inertia=True, substeps=3)
    for frame in moving:
        nearest = min(nearest, dragon.distance(frame.x, frame.t)[0].min())
        if frame.index % 9 == 0:
            touch = frame.contact
            print(
                f"t = {frame.t:.2f} s: {touch.walls} vertices on the dragon, {touch.pairs} contacts of the cloth with"
                f" itself, the deepest {1e3 * touch.deepest:.2f} mm"
            )
    if folder is not None:
        pbng.view.picture(frame, folder / "blanket.png", color="body")
    return nearest / dragon.thickness


if __name__ == "__main__":
    print(f"nearest / thickness = {main():.4f}")
