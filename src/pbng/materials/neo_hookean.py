"""Neo-Hookean elasticity without a logarithm, Eq. (8) (Macklin and Müller 2021, with λ̂ = μ + λ)."""

import math

from pbng.jit import function
from pbng.linalg import cofactor, det, mat_combine, mat_scale, norm2
from pbng.materials.base import Block, ConstraintForm, Material, material
from pbng.materials.differentials import cofactor_differential, mat_dot


@function
def stretch(F, mu, lam_hat):
    """C_D = |F| and ∂C/∂F = F / C."""
    real = type(mu)
    C = math.sqrt(norm2(F))
    return C, mat_scale(real(1) / max(C, real(1e-12)), F)


@function
def volume(F, mu, lam_hat):
    """C_H = J - 1 - μ/λ̂ and ∂C/∂F = H."""
    H = cofactor(F)
    return det(F) - type(mu)(1) - mu / lam_hat, H


@material
class NeoHookean(Material):
    """Ψ = μ/2 |F|² + λ̂/2 (J - 1 - μ/λ̂)², less its value at rest; the cheapest model, its node updates are exact."""

    def energy(F, mu, lam_hat):
        real = type(mu)
        dJ = det(F) - real(1)
        return real(0.5) * mu * (norm2(F) - real(3)) + (real(0.5) * lam_hat * dJ - mu) * dJ

    def stress(F, mu, lam_hat):
        return mat_combine(mu, F, lam_hat * (det(F) - type(mu)(1)) - mu, cofactor(F))

    def hessian(F, D, mu, lam_hat):
        one = type(mu)(1)
        H = cofactor(F)
        pressure = lam_hat * (det(F) - one) - mu
        volume = mat_combine(lam_hat * mat_dot(H, D), H, pressure, cofactor_differential(F, D))
        return mat_combine(mu, D, one, volume)

    def parameters(self) -> tuple[float, ...]:
        return self.mu, self.mu + self.lam

    def block(self) -> Block:
        """a = μ, b = λ̂: the energy is quadratic in one node's position, so this is its exact Hessian."""
        return Block(self.mu, self.mu + self.lam)

    def constraints(self) -> ConstraintForm:
        """C_D = |F| with k = μ and C_H = J - 1 - μ/λ̂ with k = λ̂ (Macklin and Müller 2021)."""
        return ConstraintForm((stretch, volume), (self.mu, self.mu + self.lam), met_at_rest=False)
