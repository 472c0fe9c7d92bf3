"""The membrane of cloth, Eq. (36): fixed corotated elasticity of a surface, F of two columns a, b.

No SVD: with m = a x b, J = |m| and n = m / J the stretch S of F = R S has s = tr S = sqrt(|a|² + |b|² + 2 J), and
R = ∂s/∂F = (F + ∂J/∂F) / s with ∂J/∂F = [b x n, n x a].
"""

import math
from functools import cached_property

from pbng.errors import InputError
from pbng.jit import function
from pbng.linalg import add, combine, cross, dot, scale, sub
from pbng.materials.base import Block, Material, material


@function
def area(F):
    """J = |a x b| and ∂J/∂F, which is zero where F is degenerate: a mean of the slopes that J, a cone, has there."""
    real = type(F[0][0])
    m = cross(F[0], F[1])
    J = math.sqrt(dot(m, m))
    n = scale(real(1) / max(J, real(1e-18)), m)
    return J, (cross(F[1], n), cross(n, F[0]))


@function
def strain(F):
    """|F - R|², F - R, J and ∂J/∂F; the first without cancellation near rest."""
    real = type(F[0][0])
    J, (c0, c1) = area(F)
    square = dot(F[0], F[0]) + dot(F[1], F[1])
    s = math.sqrt(square + real(2) * J)
    d = real(1) / max(s, real(1e-18))
    D = sub(F[0], scale(d, add(F[0], c0))), sub(F[1], scale(d, add(F[1], c1)))
    far = square - real(2) * s + real(2)  # also where R is not unique and comes out short
    near = dot(D[0], D[0]) + dot(D[1], D[1])
    return near if far < real(0.1) else far, D, J, (c0, c1)


@function
def change(F, D, mu, lam):
    """δP along D, with the slopes of J bounded where F is degenerate."""
    real = type(mu)
    m, dm = cross(F[0], F[1]), add(cross(D[0], F[1]), cross(F[0], D[1]))
    J, c = area(F)
    square = dot(F[0], F[0]) + dot(F[1], F[1])
    r = real(1) / max(J, real(1e-6) * square + real(1e-30))
    n = scale(r, m)
    dJ = dot(n, dm)
    dn = scale(r, combine(real(1), dm, -dJ, n))
    dc = add(cross(D[1], n), cross(F[1], dn)), add(cross(dn, F[0]), cross(n, D[0]))
    G = add(F[0], c[0]), add(F[1], c[1])  # s R
    d = real(1) / math.sqrt(max(square + real(2) * J, real(1e-12)))
    ds = d * (dot(G[0], D[0]) + dot(G[1], D[1]))
    t, two = lam * (J - real(1)), real(2) * mu
    dR = (
        scale(d, combine(real(1), add(D[0], dc[0]), -ds * d, G[0])),
        scale(d, combine(real(1), add(D[1], dc[1]), -ds * d, G[1])),
    )
    return (
        add(scale(two, sub(D[0], dR[0])), combine(lam * dJ, c[0], t, dc[0])),
        add(scale(two, sub(D[1], dR[1])), combine(lam * dJ, c[1], t, dc[1])),
    )


@material
class Membrane(Material):
    """Ψ = μ |F - R|² + λ/2 (J - 1)² [J/m²], Eq. (36), for triangles in space; it resists no bending.

    μ and λ follow from E and nu by Eq. (9), as the paper has it: a strip with free sides is then as stiff as
    E / (1 - nu²), and narrows by nu / (1 - nu) of its strain.

    Args:
        E: Young's modulus of the cloth [N/m], or with a thickness of its stuff [Pa].
        nu: Poisson's ratio, in [0, 0.5).
        density: Mass density per area [kg/m²].
        thickness: Of the cloth [m]; E is multiplied by it.
    """

    surface = True
    density: float = 0.1
    thickness: float | None = None

    def energy(F, mu, lam):
        real = type(mu)
        strain2, _D, J, _c = strain(F)
        dJ = J - real(1)
        return mu * strain2 + real(0.5) * lam * dJ * dJ

    def stress(F, mu, lam):
        real = type(mu)
        _strain2, D, J, c = strain(F)
        t = lam * (J - real(1))
        return combine(real(2) * mu, D[0], t, c[0]), combine(real(2) * mu, D[1], t, c[1])

    def hessian(F, D, mu, lam):
        return change(F, D, mu, lam)

    def __post_init__(self) -> None:
        if self.thickness is not None and not (math.isfinite(self.thickness) and self.thickness > 0):
            raise InputError(f"Membrane: thickness must be positive and finite, not {self.thickness}")
        super().__post_init__()
        if self.nu < 0:  # J² outgrows |F|², so that the energy would have no lower bound, nor a majorising block
            raise InputError(f"Membrane: Poisson's ratio nu must not be negative, not {self.nu}")

    @cached_property
    def mu(self) -> float:
        """Lamé's shear modulus μ [N/m], Eq. (9)."""
        return super().mu * (self.thickness or 1.0)

    @cached_property
    def lam(self) -> float:
        """Lamé's λ [N/m], Eq. (9)."""
        return super().lam * (self.thickness or 1.0)

    def block(self) -> Block:
        """a = 2μ, b = λ: s is convex in F, (J - 1)² is a quadratic less a convex function of one node's position."""
        return self.paper_block()
