"""pypbd's XPBD of tets (method 3 of its solid constraints): Saint Venant-Kirchhoff, float64, one constraint a tet.

XPBD steps motion. It is made quasistatic by setting all velocities to zero before each step, in a Python loop that the
clock leaves out. It has no residual to reach: its multipliers begin anew with each step, so the state at which it stays
depends on the time step. The one chosen is the smallest that still gets anywhere; with more than one iteration a step
smaller steps than 0.01 s blow up. Its gravity cannot be turned off from Python; it is 5e-6 of the first residual of the
corotated model. The material was checked: one tet moves along the gradient of that energy to the last digit.
"""

from importlib.metadata import version

from pypbd_body import build, constrain, place, positions, stop
from record import arguments

DT = 1e-4  # s


def main() -> None:
    problem, record = arguments()
    with record.phase("set-up"):
        simulation, model, particles = build(problem, DT)
        constrain(model, problem)
        stepper, steps = simulation.getTimeStep(), 0
        stepper.step(model)  # colours the constraints
    place(particles, problem.x0)
    record.add(steps, lambda: positions(particles))
    while not record.over:
        stop(particles)
        with record:
            stepper.step(model)
        steps += 1
        record.add(steps, lambda: positions(particles))
    record.close({"pypbd": version("pypbd")}, unit="iteration", colors=len(model.getConstraintGroups()))


if __name__ == "__main__":
    main()
