"""The public names: what type checkers read, and what ``__init__.py`` loads lazily."""

from . import gallery as gallery, linalg as linalg, shapes as shapes, view as view
from .bodies import Body as Body, Points as Points, Selection as Selection
from .contact.colliders import Box as Box, Capsule as Capsule, Plane as Plane, Sphere as Sphere, container as container
from .contact.kinematic import Kinematic as Kinematic
from .drivers import Frame as Frame, default_solver as default_solver, simulate as simulate, solve as solve
from .errors import InputError as InputError
from .io.export import export as export
from .io.frames import FrameWriter as FrameWriter, read_run as read_run
from .io.meshes import read_mesh as read_mesh, read_surface as read_surface
from .materials.base import Block as Block, ConstraintForm as ConstraintForm, Material as Material, material as material
from .materials.bending import Bending as Bending
from .materials.check import check_material as check_material
from .materials.corotated import Corotated as Corotated
from .materials.invariants import InvariantMaterial as InvariantMaterial
from .materials.linear import LinearElastic as LinearElastic
from .materials.membrane import Membrane as Membrane
from .materials.neo_hookean import NeoHookean as NeoHookean
from .materials.stable_neo_hookean import StableNeoHookean as StableNeoHookean
from .mesh import Embedding as Embedding, TetMesh as TetMesh, TriMesh as TriMesh
from .mesh_quality import quality as quality
from .meshing import creature as creature, tetrahedralize as tetrahedralize
from .motions import Animation as Animation, Motion as Motion, Rotate as Rotate, Scale as Scale, Translate as Translate
from .problem import Problem as Problem
from .scene import Scene as Scene
from .solvers.acceleration import SOR as SOR, Anderson as Anderson, Chebyshev as Chebyshev, NodeSOR as NodeSOR
from .solvers.base import Budget as Budget, Progress as Progress, Result as Result, Status as Status
from .solvers.linear import AMG as AMG, CG as CG, BiCGSTAB as BiCGSTAB, Direct as Direct, GaussSeidel as GaussSeidel
from .solvers.multigrid import MultigridPBNG as MultigridPBNG
from .solvers.newton import Newton as Newton
from .solvers.pbng import PBNG as PBNG
from .solvers.xpbd import PBD as PBD, XPBD as XPBD

__version__: str
