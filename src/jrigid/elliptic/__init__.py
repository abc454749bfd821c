r"""Elliptic integrals and functions: Carlson's, Legendre's and Jacobi's.

Functions of real arguments of any broadcastable shapes, elementwise like scipy's; they
follow the dtype of their arguments. The parameter is m = k^2, as in scipy; every
function of m also takes the keyword `mc` = 1 - m, which wins, and keeps its digits
where m is near 1. Outside the real domain the answer is NaN. Every loop has a fixed
length, and every derivative, of any order and in any mode, is a closed form or comes of
a loop of positive terms.
"""

from jrigid._public import list_public_names as _list_public_names
from jrigid.elliptic._carlson import rc as rc
from jrigid.elliptic._carlson import rd as rd
from jrigid.elliptic._carlson import rf as rf
from jrigid.elliptic._carlson import rj as rj
from jrigid.elliptic._jacobi import JacobiFunctions as JacobiFunctions
from jrigid.elliptic._jacobi import am as am
from jrigid.elliptic._jacobi import ellipj as ellipj
from jrigid.elliptic._legendre import ellipe as ellipe
from jrigid.elliptic._legendre import ellipeinc as ellipeinc
from jrigid.elliptic._legendre import ellipk as ellipk
from jrigid.elliptic._legendre import ellipkinc as ellipkinc
from jrigid.elliptic._legendre import ellippi as ellippi
from jrigid.elliptic._legendre import ellippiinc as ellippiinc

_list_public_names(__name__)
