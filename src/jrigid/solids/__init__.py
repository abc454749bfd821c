"""Mass properties of homogeneous solids and shells, in closed form.

Every body has its centre of mass at the origin of the coordinates, except where a
function says otherwise, its axis of symmetry along z and its principal axes along x, y,
z. Move it with `.translated` and `.rotated`, join bodies with `+`. A body is NaN where
its mass or a length is not positive and finite, or where its lengths do not fit
together.

Source: Beer, Johnston, Mazurek and Cornwell, Vector Mechanics for Engineers: Dynamics,
10th ed., 9.11-9.17 and inside cover; torus and capsule by integration.
"""

from jrigid._public import list_public_names as _list_public_names
from jrigid.solids._round import capsule as capsule
from jrigid.solids._round import cone as cone
from jrigid.solids._round import cylinder as cylinder
from jrigid.solids._round import disk as disk
from jrigid.solids._round import ellipsoid as ellipsoid
from jrigid.solids._round import hoop as hoop
from jrigid.solids._round import shell as shell
from jrigid.solids._round import sphere as sphere
from jrigid.solids._round import torus as torus
from jrigid.solids._round import tube as tube
from jrigid.solids._straight import box as box
from jrigid.solids._straight import lamina as lamina
from jrigid.solids._straight import rod as rod
from jrigid.solids._straight import tetrahedron as tetrahedron

_list_public_names(__name__)
