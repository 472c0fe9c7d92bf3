"""What a gallery function returns: a scene, and how it is meant to be run."""

from dataclasses import dataclass, field

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
        if self.frames is not None and self.frames < 1:
            raise InputError(f"Recipe: frames must be at least 1, not {self.frames}")
        if not self.fps > 0:
            raise InputError(f"Recipe: fps must be positive, not {self.fps}")
