"""NVIDIA Newton's SolverVBD on the CPU: Neo-Hookean (8), float32, one thread (Warp's CPU kernels are serial).

Vertex block descent steps backward Euler in time. It is made quasistatic by a step of a second, against which inertia
is 1e-7 of the stiffness, no gravity, and velocities set to zero before each step. Prescribed vertices have no mass and
are not active. What is left is a sweep over the vertices with the exact 3x3 Hessian of Neo-Hookean elasticity, colour
by colour: plain PBNG, with no acceleration.
"""

import newton
import numpy as np
import warp as wp
from record import arguments

SWEEPS = 5  # a step


def main() -> None:
    wp.config.quiet = True
    wp.init()
    wp.set_device("cpu")
    problem, record = arguments()
    mu = problem.E / (2 * (1 + problem.nu))
    lam = problem.E * problem.nu / ((1 + problem.nu) * (1 - 2 * problem.nu))
    with record.phase("set-up"):
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        builder.add_soft_mesh(
            pos=wp.vec3(0, 0, 0),
            rot=wp.quat_identity(),
            scale=1.0,
            vel=wp.vec3(0, 0, 0),
            vertices=[wp.vec3(*p) for p in problem.X],
            indices=problem.cells.ravel().tolist(),
            density=problem.density,
            k_mu=mu,
            k_lambda=lam,
            k_damp=0.0,
            add_surface_mesh_edges=False,
        )
        for i in np.flatnonzero(problem.fixed):
            builder.particle_mass[i] = 0.0
            builder.particle_flags[i] = int(builder.particle_flags[i]) & ~int(newton.ParticleFlags.ACTIVE)
        builder.color()
        model = builder.finalize(device="cpu")
        solver = newton.solvers.SolverVBD(model, iterations=SWEEPS, particle_enable_self_contact=False)
        control, states = model.control(), [model.state(), model.state()]

    def step() -> None:
        for state in states:
            state.particle_qd.zero_()
        solver.step(*states, control, None, 1.0)
        states.reverse()

    def begin() -> None:
        for state in states:
            state.particle_q.assign(problem.x0.astype(np.float32))

    begin()
    with record.phase("compilation"):  # of Warp's kernels, or loading them from its cache, and one step
        step()
    begin()
    sweeps = 0
    record.add(sweeps, lambda: states[0].particle_q.numpy())
    while not record.over:
        with record:
            step()
        sweeps += SWEEPS
        record.add(sweeps, lambda: states[0].particle_q.numpy())
    colors = len(model.particle_color_groups)
    record.close({"newton": newton.__version__, "warp-lang": wp.__version__}, unit="sweep", colors=colors)


if __name__ == "__main__":
    main()
