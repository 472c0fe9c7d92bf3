"""Motions that start and stop gently, as films want them."""

from dataclasses import dataclass

import numpy as np

from pbng.motions import Motion


@dataclass(frozen=True)
class Eased(Motion):
    """Another motion, from rest to rest: the share s of it that is done becomes s² (3 - 2 s)."""

    motion: Motion

    def at(self, X: np.ndarray, center: np.ndarray, s: float, t: float) -> np.ndarray:
        return self.motion.at(X, center, s * s * (3 - 2 * s), t)
