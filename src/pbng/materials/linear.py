"""Linear elasticity, Eqs. (38)-(39): for verification against analytic solutions, not for large rotations."""

from typing import ClassVar

from pbng.linalg import identity, mat_add, mat_combine, mat_scale, mat_sub, norm2, trace, transpose
from pbng.materials.base import Block, Material, material


@material
class LinearElastic(Material):
    """Ψ = μ |ε|² + λ/2 (tr ε)², ε = (F + Fᵀ)/2 - I."""

    isotropic: ClassVar[bool] = False  # not objective: it needs F in the axes of the rest state

    def energy(F, mu, lam):
        real = type(mu)
        eps = mat_sub(mat_scale(real(0.5), mat_add(F, transpose(F))), identity(mu))
        t = trace(eps)
        return mu * norm2(eps) + real(0.5) * lam * t * t

    def stress(F, mu, lam):
        real = type(mu)
        one = identity(mu)
        eps = mat_sub(mat_scale(real(0.5), mat_add(F, transpose(F))), one)
        return mat_combine(real(2) * mu, eps, lam * trace(eps), one)

    def hessian(F, D, mu, lam):
        return mat_combine(mu, mat_add(D, transpose(D)), lam * trace(D), identity(mu))

    def block(self) -> Block:
        """a = μ, b = λ + μ with the rest state's cofactor: the exact, constant Hessian of one node."""
        return Block(self.mu, max(self.lam + self.mu, 0.0), at_rest=True)
