"""What a gallery function returns: a scene, and how it is meant to be run."""

import operator
from dataclasses import dataclass, field
from typing import Any

from pbng.checks import checked_number
from pbng.errors import InputError
from pbng.scene import Scene
from pbng.solvers.base import Budget, Solver


@dataclass(frozen=True, eq=False)
class Recipe:
    """A scene with the run that shows it best; ``pbng run`` takes what its options do not say from here.

    Attributes:
        scene: What is simulated.
        frames: Frames, the one at time 0 included; by default as many as it takes for every motion to end.
        fps: Frames a second [1/s].
        solver: Who solves it; by default whoever suits the budget (:func:`pbng.drivers.default_solver`).
        budget: What each frame may take; with inertia, each step.
        inertia: Whether it moves, by backward Euler, instead of being at rest in every frame.
        dt, substeps: Longest time step [s], or steps a frame, as :func:`pbng.simulate` takes them.
    """

    scene: Scene
    frames: int | None = None
    fps: float = 30.0
    solver: Solver | None = None
    budget: Budget = field(default_factory=Budget)
    inertia: bool = False
    dt: float | None = None
    substeps: int | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.scene, Scene):
            raise InputError(f"Recipe: scene must be a Scene, not {type(self.scene).__name__}")
        for name in ("frames", "substeps"):
            if getattr(self, name) is not None:
                checked_count(f"Recipe: {name}", getattr(self, name), 1)
        object.__setattr__(self, "fps", checked_number("Recipe: fps", self.fps))
        if self.dt is not None:
            object.__setattr__(self, "dt", checked_number("Recipe: dt", self.dt))
            if self.substeps is not None:
                raise InputError(f"Recipe: give dt or substeps, not both ({self.dt} and {self.substeps})")
        if self.solver is not None and (isinstance(self.solver, type) or not hasattr(self.solver, "set_up")):
            raise InputError(f"Recipe: solver must be one such as pbng.PBNG(), not {self.solver!r}")
        if not isinstance(self.budget, Budget):
            raise InputError(f"Recipe: budget must be a Budget, not {self.budget!r}")


def checked_count(what: str, value: Any, least: int) -> int:
    """A whole number of at least so much; InputError if it is not one."""
    try:
        count = operator.index(value)
    except TypeError:
        count = least - 1
    if count < least:
        raise InputError(f"{what} must be a whole number of at least {least}, not {value!r}")
    return count
