"""Saint Venant-Kirchhoff elasticity, which MuJoCo's flex and pypbd solve, as a user material of pbng."""

import pbng
from pbng.linalg import identity, mat_combine, mat_mul, mat_scale, norm2, trace, transpose


@pbng.material
class StVK(pbng.Material):
    """Ψ = μ |G|² + λ/2 (tr G)² with Green's strain G = (FᵀF - I) / 2; quartic in F, weak in compression.

    Its curvature grows without bound, so no two numbers majorise it everywhere. These fit a line that is drawn out to
    ``stretch``, where the curvature of one at rest, 2μ + λ, has been multiplied by (3 stretch² - 1) / 2. Where tets are
    drawn out further, pbng relaxes sweeps that raise the energy.
    """

    stretch: float = 2.5

    def energy(F, mu, lam):
        real = type(mu)
        G = mat_scale(real(0.5), mat_combine(real(1), mat_mul(transpose(F), F), real(-1), identity(mu)))
        tr = trace(G)
        return mu * norm2(G) + real(0.5) * lam * tr * tr

    def stress(F, mu, lam):
        real = type(mu)
        G = mat_scale(real(0.5), mat_combine(real(1), mat_mul(transpose(F), F), real(-1), identity(mu)))
        return mat_mul(F, mat_combine(real(2) * mu, G, lam * trace(G), identity(mu)))

    def block(self):
        return pbng.Block(a=(3 * self.stretch**2 - 1) / 2 * (2 * self.mu + self.lam), b=0.0)
