"""7. Plane strain: a sheet of triangles in the plane stands for a long body of that section.

A block is pressed between rough plates. Far from them it is as stiff as the theory of plane strain says, E / (1 - ν²);
the strain there is read off the mesh, the force from the plates.
"""

import numpy as np

import pbng


def main(folder=None, vertices=13):
    """Returns the stiffness in the middle of the block over E / (1 - ν²)."""
    E, nu, length, width = 1e5, 0.3, 4.0, 1.0
    mesh = pbng.shapes.rectangle((length, width), (4 * vertices - 3, vertices))
    scene = pbng.Scene()
    block = scene.add(mesh, pbng.Corotated(E=E, nu=nu))  # triangles in the plane: plane strain, per metre of depth
    scene.pin(block.where(x=0.0))
    plate = block.where(x=length)
    scene.move(plate, pbng.Translate((-0.002 * length, 0.0, 0.0)))
    problem = scene.compile()
    result = pbng.solve(problem, pbng.PBNG(dtype="float64"), pbng.Budget(rtol=1e-5))

    gauge = [block.where(x=x).index for x in (1.5, 2.5)]
    u = result.x - mesh.X
    strain = np.diff([u[section, 0].mean() for section in gauge])[0] / 1.0
    across = np.ptp(result.x[block.where(x=2.0).index, 1]) / width - 1
    stress = -problem.forces(result.x)[plate.index, 0].sum() / width
    print(f"{result.iterations} sweeps; strain {strain:.5f} along, {across:.5f} across")
    print(f"effective Poisson's ratio {-across / strain:.4f}, theory {nu / (1 - nu):.4f}")
    return float(stress / strain / (E / (1 - nu**2)))


if __name__ == "__main__":
    print(f"stiffness / theory = {main():.4f}")
