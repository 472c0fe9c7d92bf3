"""5. Several materials and several bodies in one scene.

A bar is half soft, half stiff: two cell groups of one mesh. Above it are two bars of one material each. All are drawn
out alike. In series the strains of the halves are in the inverse ratio of their stiffnesses (Poisson's ratio is 0).
"""

import numpy as np

import pbng


def main(folder=None, vertices=4):
    """Returns the strain of the soft half over that of the stiff half, times the ratio of the stiffnesses."""
    soft, stiff = pbng.Corotated(E=1e5, nu=0.0), pbng.NeoHookean(E=3e5, nu=0.0)
    plain = pbng.shapes.beam(2.0, 0.5, vertices)
    left = plain.X[plain.cells, 0].mean(1) < 1.0
    layered = pbng.TetMesh(plain.X, plain.cells, cell_groups={"left": left, "right": ~left})

    scene = pbng.Scene(name="bars")
    bars = [
        scene.add(layered, {"left": soft, "right": stiff}, name="layered"),
        scene.add(plain, soft, name="soft", at=(0.0, 1.0, 0.0)),
        scene.add(plain, stiff, name="stiff", at=(0.0, 2.0, 0.0)),
    ]
    for bar in bars:
        scene.pin(bar.where(x=0.0))
        scene.move(bar.where(x=2.0), pbng.Translate((0.02, 0.0, 0.0)))
    problem = scene.compile()
    print(f"{problem.n_vert} vertices, {problem.n_elem} tets, {problem.color.max() + 1} colours")
    for group in problem.groups:
        print(f"  {len(group.cells):5d} {group.kind.name}s of {group.material}")
    result = pbng.solve(problem, pbng.PBNG(dtype="float64"), pbng.Budget(rtol=1e-5))

    force, moved = problem.forces(result.x), result.x - problem.X
    for bar in bars:
        joint = moved[bar.where(x=1.0).index, 0].mean()
        pull = -force[bar.where(x=2.0).index, 0].sum()
        print(f"{bar.name:<8} middle moved {joint * 1e3:6.3f} mm, force {pull:7.2f} N")
    joint = np.mean(moved[bars[0].where(x=1.0).index, 0])
    return float(joint / (0.02 - joint) * soft.E / stiff.E)


if __name__ == "__main__":
    print(f"strain ratio x stiffness ratio = {main():.4f}")
