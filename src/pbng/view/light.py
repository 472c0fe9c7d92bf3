"""How light falls on a surface: three wide lamps and the sky, worked out a point at a time.

Lit here rather than by the renderer, pictures are the same on every machine, lamps can be as wide as in a studio, and
a renderer in software is several times faster.
"""

import numpy as np

# Where from, seen from the camera (right, up, back); colour; strength; how far around the edge it reaches.
LAMPS = (
    ((-0.60, 0.75, 0.85), (1.00, 0.985, 0.96), 0.48, 0.30),  # key
    ((1.00, 0.30, 0.80), (0.95, 0.975, 1.00), 0.22, 0.30),  # fill
    ((0.30, 0.70, -0.90), (1.00, 1.00, 1.00), 0.11, 0.10),  # rim
)
SKY = np.array([0.455, 0.465, 0.485])
GROUND = np.array([0.38, 0.37, 0.36])


class Light:
    """Light (n, 3) on points with unit normals (n, 3): ``light(normals)``; 1 leaves a colour as it is.

    ``frame`` (3, 3) has the camera's right, up and back as rows.
    """

    def __init__(self, frame: np.ndarray) -> None:
        towards = np.array([place for place, *_ in LAMPS]) @ frame
        self.towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)

    def __call__(self, normals: np.ndarray) -> np.ndarray:
        up = (normals[:, 1:2] + 1) / 2
        light = GROUND + (SKY - GROUND) * up
        for towards, (_, color, strength, around) in zip(self.towards, LAMPS):
            facing = np.maximum((normals @ towards + around) / (1 + around), 0)
            light += strength * facing[:, None] * color
        return light
