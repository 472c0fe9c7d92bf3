"""Material axioms (design test 1), the paper's corrections, and materials of a user's own."""

import math
import os
import subprocess
import sys
import types
from dataclasses import FrozenInstanceError
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from models import RootMooney, SoftVolume, Yeoh

import pbng
from pbng.jit import fingerprint
from pbng.materials import check
from pbng.materials.base import Block, Material
from pbng.materials.check import check_material
from pbng.materials.invariants import InvariantMaterial

E = 1e5
BUILT_IN = (pbng.Corotated, pbng.NeoHookean, pbng.StableNeoHookean, pbng.LinearElastic)
MODELS = (*BUILT_IN, SoftVolume, RootMooney)
POISSON = (0.3, 0.49, -0.5)


@cache
def checked(model, nu=0.3):
    return check_material(model(E=E, nu=nu))


@pytest.mark.parametrize("nu", POISSON)
@pytest.mark.parametrize("model", MODELS)
def test_stress_is_the_derivative_of_the_energy(model, nu):
    """P = ∂Ψ/∂F for regular, nearly singular and inverted F; Ψ = 0 and P = 0 at rest."""
    report = checked(model, nu)
    for name in ("stress, regular", "stress, near-singular", "stress, inverted", "rest energy", "rest stress"):
        assert report[name].ok, report


@pytest.mark.parametrize("nu", POISSON)
@pytest.mark.parametrize("model", MODELS)
def test_rest_hessian_is_linear_elasticity(model, nu):
    """∂P/∂F at F = I is μ(δδ + swap) + λ δ⊗δ with μ, λ of Eq. (9) (section 9)."""
    report = checked(model, nu)
    assert report["rest Hessian"].ok, report


@pytest.mark.parametrize("model", MODELS)
def test_frame_invariance(model):
    """Ψ(QF) = Ψ(F) = Ψ(FQ), except for linear elasticity, which is not objective and does not claim isotropy."""
    report = checked(model)
    assert report["objectivity"].ok == (model is not pbng.LinearElastic), report
    assert (report["isotropy"].value is None) == (model is pbng.LinearElastic)
    assert report["isotropy"].ok, report


@pytest.mark.parametrize("nu", POISSON)
@pytest.mark.parametrize("model", MODELS)
def test_block_majorises_and_every_state_is_finite(model, nu):
    """E(x + u) <= E(x) - f·u + ½ uᵀAu for one node from any state, collapsed and inverted ones included."""
    report = checked(model, nu)
    assert report["block"].ok, report
    assert report["finite"].ok, report


@pytest.mark.parametrize("model", MODELS)
def test_stress_in_float32(model):
    report = checked(model)
    assert report["float32"].ok, report


@pytest.mark.parametrize("model", MODELS)
def test_axioms_have_no_scale(model):
    """Everything but μ and λ is a pure number: a material a million million times stiffer does as well."""
    soft, stiff = (check_material(model(E=s, nu=0.3)) for s in (1e-3, 1e9))
    assert soft.failed == stiff.failed
    assert soft["objectivity"].value == pytest.approx(stiff["objectivity"].value, abs=1e-13, rel=1e-9)


def paper_block_of(model, **constants):
    """The model with the paper's block in place of its own."""
    body = {"block": lambda self: self.paper_block(), "__module__": __name__}
    return pbng.material(type(f"{model.__name__}PaperBlock", (model,), body))(**constants)


@pytest.mark.parametrize("model", [pbng.NeoHookean, pbng.StableNeoHookean])
def test_papers_block_is_no_majoriser(model):
    """Eq. (32)'s a = 2μ, b = λ fails for both Neo-Hookean models in a good part of all configurations."""
    report = check_material(paper_block_of(model, E=E, nu=0.3))
    assert 200 < report["block"].value < check.N_NODE
    assert report.failed == ("block",)
    assert "largest stretch" in report["block"].note


def test_papers_block_is_corotateds_own():
    m = pbng.Corotated(E=E, nu=0.3)
    assert m.block() == m.paper_block() == Block(2 * m.mu, m.lam)


def test_lost_factor_of_stable_neo_hookean():
    """Eq. (10) as printed, without the factor λ' before (J - α)²/2, has a rest stress of 3/4 μ (1 - 1 Pa/λ)."""

    @pbng.material
    class AsPrinted(pbng.StableNeoHookean):
        def energy(F, mu, lam):
            real = type(mu)
            n, dJ = pbng.linalg.norm2(F), pbng.linalg.det(F) - real(1) - real(0.75) * mu / lam
            return real(0.5) * (mu * (n - real(3)) + dJ * dJ - mu * math.log(real(1) + n))

        def stress(F, mu, lam):
            real = type(mu)
            p = pbng.linalg.det(F) - real(1) - real(0.75) * mu / lam
            a = mu - mu / (real(1) + pbng.linalg.norm2(F))
            return pbng.linalg.mat_combine(a, F, p, pbng.linalg.cofactor(F))

        def parameters(self):
            return self.mu, self.lam

    m = AsPrinted(E=E, nu=0.3)
    report = check_material(m)
    assert report["stress, regular"].ok
    rest_stress = report["rest stress"].value * m.block().a / math.sqrt(3)
    assert rest_stress == pytest.approx(0.75 * m.mu * (1 - 1 / m.lam), rel=1e-9)


@pytest.mark.parametrize("model", [pbng.NeoHookean, pbng.StableNeoHookean])
def test_lame_parameters_must_be_adjusted(model):
    """With μ, λ in place of λ̂ = λ + μ (8), or of μ' = 4/3 μ, λ' = λ + 5/6 μ (10), linear elasticity is lost."""

    @pbng.material
    class Unadjusted(model):
        def parameters(self):
            return self.mu, self.lam

    report = check_material(Unadjusted(E=E, nu=0.3))
    assert report["rest stress"].ok
    assert report["rest Hessian"].value > 0.1


def test_lame_parameters():
    """Eq. (9): μ = E / 2(1 + ν), λ = Eν / (1 + ν)(1 - 2ν)."""
    m = pbng.Corotated(E=2.6, nu=0.3)
    assert m.mu == pytest.approx(1.0)
    assert m.lam == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("constants", "word"),
    [
        ({"E": 0.0, "nu": 0.3}, "E must be positive and finite, not 0.0"),
        ({"E": -1.0, "nu": 0.3}, "E must be positive"),
        ({"E": np.nan, "nu": 0.3}, "E must be positive and finite, not nan"),
        ({"E": np.inf, "nu": 0.3}, "E must be positive and finite, not inf"),
        ({"E": 1.0, "nu": 0.5}, "nu must lie strictly between -1 and 0.5, not 0.5"),
        ({"E": 1.0, "nu": -1.0}, "nu must lie strictly between -1 and 0.5, not -1.0"),
        ({"E": 1.0, "nu": np.nan}, "nu must lie"),
        ({"E": 1.0, "nu": 0.3, "density": -1.0}, "density must be finite and not negative"),
        ({"E": 1.0, "nu": 0.3, "density": np.inf}, "density must be finite"),
    ],
)
@pytest.mark.parametrize("model", BUILT_IN)
def test_bad_constants_are_named(model, constants, word):
    with pytest.raises(pbng.InputError, match=f"{model.__name__}: .*{word}"):
        model(**constants)


def test_materials_are_frozen_and_compare_by_value():
    a, b = pbng.Corotated(E=1.0, nu=0.3), pbng.Corotated(E=1.0, nu=0.3)
    assert a == b
    assert hash(a) == hash(b)
    assert a != pbng.NeoHookean(E=1.0, nu=0.3)
    with pytest.raises(FrozenInstanceError):
        a.E = 2.0


def test_material_without_a_base_class():
    """``@pbng.material`` makes a plain class a Material; own fields become constants of the model."""

    @pbng.material
    class Plain:
        extra: float = 2.0

        def energy(F, mu, lam):
            return mu * pbng.linalg.norm2(F)

        def stress(F, mu, lam):
            return pbng.linalg.mat_scale(type(mu)(2) * mu, F)

    m = Plain(E=1.0, nu=0.0, extra=3.0)
    assert isinstance(m, Material)
    assert m.extra == 3.0
    assert set(check_material(m).failed) >= {"rest energy", "rest stress", "rest Hessian"}


def test_bad_block_is_named():
    @pbng.material
    class NoBlock(pbng.Corotated):
        def block(self):
            return Block(-1.0, 0.0)

    with pytest.raises(pbng.InputError, match="NoBlock: the block needs finite a > 0"):
        NoBlock(E=1.0, nu=0.3)


def test_invariants_give_the_stress():
    """P = 2 d0 F + 4 d1 F FᵀF + d2 cof F (Eqs. 40-41), here with all of the shear modulus in I1."""
    report = check_material(RootMooney(E=E, nu=0.3, share=1.0))
    assert report.ok, report


def test_quartic_material_has_no_constant_block():
    """A model that grows like |F|⁴ keeps every other axiom; the report says that, and where, its block fails."""
    report = check_material(Yeoh(E=E, nu=0.3, c2=2e3))
    assert report.failed == ("block",)
    assert not report.ok
    assert "FAILS  of 2000 nodes; from a largest stretch of 1." in str(report)


def test_default_block_of_invariant_materials_is_the_papers():
    m = Yeoh(E=E, nu=0.3)
    assert m.block() == Block(2 * m.mu, m.lam)


def test_invariant_material_must_define_both():
    with pytest.raises(pbng.InputError, match=r"Half defines no invariant_derivatives\(I0, I1, I2, \*parameters\)"):

        class Half(InvariantMaterial):
            def invariant_energy(I0, I1, I2, mu, lam):
                return mu * (I0 - 3)


def test_wrong_stress_is_found():
    """The check can fail: a stress without the cofactor term is not the derivative of its energy."""

    @pbng.material
    class Wrong(pbng.NeoHookean):
        def stress(F, mu, lam_hat):
            return pbng.linalg.mat_scale(mu, F)

    assert set(check_material(Wrong(E=E, nu=0.3)).failed) >= {"stress, regular", "stress, inverted", "rest stress"}


def test_logarithm_of_j_is_found():
    """A model with log J has no value for inverted elements: PBNG cannot use it, and the check says so."""

    @pbng.material
    class LogJ(InvariantMaterial):
        def invariant_energy(I0, I1, I2, mu, lam):
            log = np.log(I2)
            return mu * ((I0 - 3) / 2 - log) + lam * log * log / 2

        def invariant_derivatives(I0, I1, I2, mu, lam):
            return mu / 2, type(mu)(0), (lam * np.log(I2) - mu) / I2

    report = check_material(LogJ(E=E, nu=0.3))
    assert "finite" in report.failed
    assert report["stress, regular"].ok
    assert report["rest Hessian"].ok


def test_anisotropic_material_must_say_so():
    """A fibre along x breaks Ψ(FQ) = Ψ(F): found if the class claims isotropy, not claimed if it does not."""

    def fibred(claims):
        @pbng.material
        class Fibred(pbng.NeoHookean):
            isotropic = claims

            def energy(F, mu, lam_hat):
                real = type(mu)
                dJ = pbng.linalg.det(F) - real(1)
                growth = pbng.linalg.norm2(F) - real(3)
                fibre = pbng.linalg.dot(F[0], F[0]) - real(1)
                return real(0.5) * (mu * growth + mu * fibre * fibre) + (real(0.5) * lam_hat * dJ - mu) * dJ

            def stress(F, mu, lam_hat):
                one = type(mu)(1)
                fibre = pbng.linalg.dot(F[0], F[0]) - one
                P = pbng.linalg.mat_combine(mu, F, lam_hat * (pbng.linalg.det(F) - one) - mu, pbng.linalg.cofactor(F))
                return pbng.linalg.combine(one, P[0], one * 2 * mu * fibre, F[0]), P[1], P[2]

        return check_material(Fibred(E=E, nu=0.3))

    claimed, honest = fibred(True), fibred(False)
    assert "isotropy" in claimed.failed
    assert "isotropy" not in honest.failed
    assert honest["objectivity"].ok
    assert honest["stress, inverted"].ok


def test_check_is_deterministic_and_readable():
    m = RootMooney(E=E, nu=0.3)
    first, again = check_material(m), check_material(m)
    assert first == again
    lines = str(first).splitlines()
    assert lines[0].startswith("RootMooney(E=100000.0, nu=0.3")
    assert lines[0].endswith("11 of 11 axioms hold")
    assert len(lines) == 1 + len(first.axioms)
    assert all(" <= " in line for line in lines[1:])
    with pytest.raises(KeyError, match="no axiom 'beauty'"):
        first["beauty"]


@pytest.mark.parametrize("thing", [pbng.Corotated, None, 3.0])
def test_check_of_something_else(thing):
    with pytest.raises(pbng.InputError, match="expected a material such as"):
        check_material(thing)


def test_material_that_does_not_compile_is_named():
    @pbng.material
    class Broken(pbng.Corotated):
        def energy(F, mu, lam):
            return F.no_such_thing

    with pytest.raises(pbng.InputError, match="Broken: energy or stress does not compile"):
        check_material(Broken(E=1.0, nu=0.3))


SCRIPT = """
import numpy as np, pbng
from pbng.jit import compile_seconds
from pbng.jit import fingerprint
from pbng.materials import check
from pbng.materials.invariants import InvariantMaterial

@pbng.material
class Mine(InvariantMaterial):
    def invariant_energy(I0, I1, I2, mu, lam):
        return FACTOR * mu * (I0 - 3)
    def invariant_derivatives(I0, I1, I2, mu, lam):
        return FACTOR * mu, 0.0, 0.0

psi, P = check._Check(Mine(E=2.0, nu=0.0))._evaluate(2 * np.eye(3)[None])
print(psi[0], P[0, 0, 0], compile_seconds() > 0)
"""


def test_kernels_of_user_materials_are_cached_across_processes(tmp_path):
    """A second process compiles nothing; a changed formula gives a new kernel, though only a closure changed."""
    script = tmp_path / "mine.py"
    src = str(Path(pbng.__file__).parents[1])
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": src, "NUMBA_NUM_THREADS": "1"}

    def run(factor):
        script.write_text(SCRIPT.replace("FACTOR", factor))
        out = subprocess.run([sys.executable, str(script)], env=env, check=True, capture_output=True, text=True)
        psi, P, compiled = out.stdout.split()
        return float(psi), float(P), compiled == "True"

    assert run("0.5") == (4.5, 2.0, True)
    assert run("0.5") == (4.5, 2.0, False)
    assert run("1.5") == (13.5, 6.0, True)


HELPER = "from numba import njit\n@njit\ndef grow(x):\n    return FACTOR * x\n"
SOURCES = {
    "a constant": "def psi(x):\n    return FACTOR * x\n",
    "a global number": "C = FACTOR\ndef psi(x):\n    return C * x\n",
    "a global function": HELPER + "def psi(x):\n    return grow(x)\n",
    "a closure": "def outer(c):\n    def psi(x):\n        return c * x\n    return psi\npsi = outer(FACTOR)\n",
    "a NumPy number": "import numpy as np\nC = np.float32(FACTOR)\ndef psi(x):\n    return C * x\n",
    "a global array": "import numpy as np\nC = np.array([FACTOR])\ndef psi(x):\n    return C[0] * x\n",
    "a function of a module": "def psi(x):\n    return helper.grow(x)\n",
    "a function of a module in a module": "def psi(x):\n    return outer.inner.grow(x)\n",
}


@pytest.mark.parametrize("what", SOURCES)
def test_fingerprint_sees_everything_a_function_calls(what):
    """Kernels are found by the fingerprint of their functions: what changes a result must change it (see jit.py)."""

    def made(factor):
        helper = types.ModuleType("helper")
        exec(HELPER.replace("FACTOR", factor), vars(helper))
        outer = types.ModuleType("outer")
        outer.inner = helper
        space = {"__name__": "users", "helper": helper, "outer": outer}
        exec(SOURCES[what].replace("FACTOR", factor), space)
        return fingerprint(space["psi"])

    assert made("2.0") == made("2.0")
    assert made("2.0") != made("3.0")
