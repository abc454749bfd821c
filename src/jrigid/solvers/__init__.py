"""diffrax solvers made for rotation."""

from jrigid.solvers._exact import ExactFree as ExactFree
from jrigid.solvers._exact import FreeRotation as FreeRotation
from jrigid.solvers._splitting import Splitting as Splitting
from jrigid.solvers._verner import Verner9 as Verner9
