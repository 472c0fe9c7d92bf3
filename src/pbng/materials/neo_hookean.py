"""Neo-Hookean elasticity without a logarithm, Eq. (8) (Macklin and Müller 2021, with λ̂ = μ + λ)."""

from pbng.linalg import cofactor, det, mat_combine, norm2
from pbng.materials.base import Block, Material, material


@material
class NeoHookean(Material):
    """Ψ = μ/2 |F|² + λ̂/2 (J - 1 - μ/λ̂)², less its value at rest; the cheapest model, its node updates are exact."""

    def energy(F, mu, lam_hat):
        real = type(mu)
        dJ = det(F) - real(1)
        return real(0.5) * mu * (norm2(F) - real(3)) + (real(0.5) * lam_hat * dJ - mu) * dJ

    def stress(F, mu, lam_hat):
        return mat_combine(mu, F, lam_hat * (det(F) - type(mu)(1)) - mu, cofactor(F))

    def parameters(self) -> tuple[float, ...]:
        return self.mu, self.mu + self.lam

    def block(self) -> Block:
        """a = μ, b = λ̂: the energy is quadratic in one node's position, so this is its exact Hessian."""
        return Block(self.mu, self.mu + self.lam)
