"""The paper's figures and tables, run again: ``pbng reproduce fig17``, ``pbng reproduce all``.

Each is a function of :class:`pbng.reproduce.section.Settings` that returns a :class:`~pbng.reproduce.section.Section`;
they are loaded on first use.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING

from pbng.errors import InputError

if TYPE_CHECKING:
    from pbng.reproduce.section import Section, Settings


@dataclass(frozen=True)
class Experiment:
    """A figure or table that can be reproduced: its name, the module with the function of that name, what it shows."""

    name: str
    module: str
    summary: str

    def __call__(self, settings: "Settings") -> "Section":
        """Run it."""
        section: Section = getattr(import_module(f"pbng.reproduce.{self.module}"), self.name)(settings)
        return section


_ALL = (
    Experiment("fig3", "dynamics", "A swinging block: XPBD's residual of backward Euler stagnates, PBNG's falls."),
    Experiment("fig7", "budgets", "Newton, PBD, XPBD-QS and PBNG on equal seconds a frame, few and many."),
    Experiment("fig8", "blocks", "The twisting block at three resolutions, 40 iterations a frame."),
    Experiment("fig9", "blocks", "The twisting block of three materials."),
    Experiment("fig10", "linear", "Newton with linear Gauss-Seidel against PBNG, iteration by iteration."),
    Experiment("fig11", "linear", "Newton with the exact Hessian breaks down; with a projected one it does not."),
    Experiment("fig12", "accelerations", "Plain, Chebyshev, SOR, and what came after."),
    Experiment("fig13", "contact", "Two blocks are driven together: contacts come, and go."),
    Experiment("fig14", "contact", "Simple shapes fall into a glass box."),
    Experiment("fig16", "contact", "Bodies fall onto a cloth that gives way."),
    Experiment("fig17", "springs", "Two blocks bound by stiff springs: XPBD-QS depends on the order."),
    Experiment("fig18", "bar", "A bar under gravity: PBD loses its weight."),
    Experiment("fig19", "cloth", "A cloth swings by two corners: too stretchy on few plain iterations."),
    Experiment("table1", "colors", "Colours of vertices and of constraints, time an iteration."),
    Experiment("table2", "budgets", "Time and iterations a frame of each method."),
    Experiment("table3", "blocks", "Time a frame of PBNG, scene by scene."),
    Experiment("table4", "linear", "Where Newton with linear Gauss-Seidel spends its time."),
)
EXPERIMENTS: Mapping[str, Experiment] = MappingProxyType({e.name: e for e in _ALL})


def find(name: str) -> Experiment:
    """The experiment of that name.

    Raises:
        InputError: There is none; it names those that come near.
    """
    if name in EXPERIMENTS:
        return EXPERIMENTS[name]
    near = get_close_matches(name.lower().replace(" ", "").replace(".", ""), EXPERIMENTS, n=2, cutoff=0.6)
    hint = f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(EXPERIMENTS)}"
    raise InputError(f"nothing called {name!r} to reproduce; {hint}")
