"""diffrax solvers made for rotation."""

from jrigid.solvers._exact import ExactFree as ExactFree
from jrigid.solvers._exact import FreeRotation as FreeRotation
from jrigid.solvers._unrolled import Unrolled as Unrolled
