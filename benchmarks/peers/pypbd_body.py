"""The block in pypbd, for the two drivers that use it."""

import numpy as np
import pypbd as pbd

METHOD = 3  # of addSolidConstraints: XPBD with the energy of a tet as its constraint


def build(problem, dt: float):
    """Simulation, model and particles of the block, prescribed vertices without mass; time step dt [s], one iteration.

    It has no constraints yet.
    """
    simulation = pbd.Simulation.getCurrent()
    simulation.initDefault()
    model = simulation.getModel()
    cells = problem.cells.ravel().tolist()
    model.addTetModel(list(problem.X), cells, testMesh=False, generateCollisionObject=False)
    particles = model.getParticles()
    for i, mass in enumerate(np.where(problem.fixed, 0.0, problem.mass)):
        particles.setMass(i, float(mass))
    stepper, options = simulation.getTimeStep(), pbd.TimeStepController
    stepper.setValueUInt(options.MAX_ITERATIONS, 1)
    stepper.setValueUInt(options.NUM_SUB_STEPS, 1)
    stepper.setValueUInt(options.MAX_ITERATIONS_V, 0)
    pbd.TimeManager.getCurrent().setTimeStepSize(dt)
    return simulation, model, particles


def constrain(model, problem) -> None:
    """Give every tet its constraint."""
    model.addSolidConstraints(model.getTetModels()[0], METHOD, float(problem.E), float(problem.nu), 1.0, False, False)


def place(particles, x: np.ndarray) -> None:
    """Put all particles at x (n, 3) [m], at rest."""
    for i, p in enumerate(x):
        particles.setPosition(i, p)
        particles.setPosition0(i, p)
    stop(particles)


def stop(particles) -> None:
    """Set every velocity to zero."""
    zero = np.zeros(3)
    for i in range(particles.size()):
        particles.setVelocity(i, zero)


def positions(particles) -> np.ndarray:
    """Positions [m], (n, 3)."""
    return np.array([particles.getPosition(i) for i in range(particles.size())])
