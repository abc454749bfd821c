"""diffrax solvers made for rotation."""

from jrigid._public import list_public_names as _list_public_names
from jrigid.solvers._exact import ExactFree as ExactFree
from jrigid.solvers._exact import FreeRotation as FreeRotation
from jrigid.solvers._splitting import Splitting as Splitting
from jrigid.solvers._verner import Verner9 as Verner9

_list_public_names(__name__)
