"""2. One equilibrium and its certificate.

A bar is drawn out by one percent. `solve` returns the state together with what it is worth: residuals and energy in
float64, whatever the sweeps were computed in. The force at the moved end is close to E A strain; a little more, because
the clamped ends cannot contract.
"""

import pbng


def main(folder=None, vertices=5):
    """Returns the force at the moved end over E A strain."""
    E, length, strain = 1e5, 4.0, 0.01
    scene = pbng.Scene()
    bar = scene.add(pbng.shapes.beam(length, 1.0, vertices), pbng.Corotated(E=E, nu=0.3))
    end = bar.where(x=length)
    scene.pin(bar.where(x=0.0))
    scene.move(end, pbng.Translate((strain * length, 0.0, 0.0)))

    problem = scene.compile()  # the discrete problem; solve and simulate take it as well as the scene
    result = pbng.solve(problem, pbng.PBNG(dtype="float64"), pbng.Budget(rtol=1e-6))

    print(result.status)
    print(f"{result.iterations} sweeps in {result.seconds * 1e3:.1f} ms")
    print(f"residual {result.residual:.2e} N, {result.reduction:.1e} of the first one")
    print(f"  and {result.relative_residual:.1e} of the sum of all element forces ({result.force_scale:.3g} N)")
    print(f"energy {result.energy:.6g} J, inverted elements {result.inverted}")
    print(f"last step {result.correction:.1e} m")
    for iteration, residual, energy in zip(result.monitored, result.residuals, result.energies):
        print(f"  {iteration:4d}  {residual:10.3e} N  {energy:12.8f} J")

    assert problem.residual(result.x) <= 1e-6 * result.residuals[0]  # anyone can check the state again
    pull = -problem.forces(result.x)[end.index, 0].sum()  # what holds the end balances the forces inside
    print(f"force at the end {pull:.1f} N; 2 energy / displacement {2 * result.energy / (strain * length):.1f} N")
    return float(pull / (E * 1.0 * strain))


if __name__ == "__main__":
    print(f"force / E A strain = {main():.4f}")
