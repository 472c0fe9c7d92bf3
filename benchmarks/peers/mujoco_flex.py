"""MuJoCo's flex, a body of tets, with the "discrete" integrator: Saint Venant-Kirchhoff, float64, one thread.

MuJoCo integrates motion. It is made quasistatic by a step of a second, against which inertia is nothing, and by setting
all velocities to zero before each step: what is left of a step is one Newton step with a positive definite stiffness,
solved by conjugate gradients, to a tolerance that proved fastest. Other integrators take no flex elasticity implicitly.

The held vertices are pinned. Those that are moved are pinned as well and then displaced by editing ``flex_vert``, the
vertices' places in the frame of the world body: a route that the manual does not describe.
"""

import mujoco
import numpy as np
from record import arguments

XML = """
<mujoco>
  <option timestep="1" gravity="0 0 0" integrator="discrete" solver="CG" tolerance="1e-3"/>
  <size memory="8G"/>
  <worldbody>
    <flexcomp name="block" type="direct" dim="3" mass="{mass}" radius="1e-4" point="{points}" element="{cells}">
      <elasticity young="{E}" poisson="{nu}" damping="0"/>
      <contact selfcollide="none" contype="0" conaffinity="0"/>
      <pin id="{pins}"/>
    </flexcomp>
  </worldbody>
</mujoco>
"""


def words(array) -> str:
    """The numbers of an array, as XML wants them."""
    return " ".join(f"{v:.17g}" for v in np.ravel(array))


def main() -> None:
    problem, record = arguments()
    fixed = problem.fixed
    with record.phase("set-up"):
        xml = XML.format(
            mass=problem.mass.sum(),
            points=words(problem.X),
            cells=words(problem.cells),
            E=problem.E,
            nu=problem.nu,
            pins=words(np.flatnonzero(fixed)),
        )
        model = mujoco.MjModel.from_xml_string(xml)
        data = mujoco.MjData(model)
        model.flex_vert[fixed] += (problem.x0 - problem.X)[fixed]

    def positions() -> np.ndarray:
        mujoco.mj_kinematics(model, data)  # a step leaves the vertices where they were before it
        mujoco.mj_comPos(model, data)
        mujoco.mj_flex(model, data)
        return data.flexvert_xpos.copy()

    step = 0
    record.add(step, positions, always=True)
    while not record.over:
        with record:
            data.qvel[:] = 0
            mujoco.mj_step(model, data)
        step += 1
        record.add(step, positions, always=True)
    record.close({"mujoco": mujoco.__version__}, unit="step")


if __name__ == "__main__":
    main()
