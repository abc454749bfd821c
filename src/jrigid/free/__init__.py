"""Free rotation: the exact flow, its periods, curves and cones."""

from jrigid._public import list_public_names as _list_public_names
from jrigid.free._curves import Poinsot as Poinsot
from jrigid.free._curves import Separatrix as Separatrix
from jrigid.free._curves import herpolhode as herpolhode
from jrigid.free._curves import poinsot as poinsot
from jrigid.free._curves import polhode as polhode
from jrigid.free._curves import separatrix as separatrix
from jrigid.free._free_rotation import free_rotation as free_rotation
from jrigid.free._free_rotation import relative_rotation as relative_rotation
from jrigid.free._periods import REGIMES as REGIMES
from jrigid.free._periods import geometric_phase as geometric_phase
from jrigid.free._periods import mean_precession_rate as mean_precession_rate
from jrigid.free._periods import modulus as modulus
from jrigid.free._periods import parameter as parameter
from jrigid.free._periods import polhode_period as polhode_period
from jrigid.free._periods import precession_per_period as precession_per_period
from jrigid.free._periods import regime as regime
from jrigid.free._symmetric import ConeAngles as ConeAngles
from jrigid.free._symmetric import cone_angles as cone_angles
from jrigid.free._symmetric import precession_rate as precession_rate
from jrigid.free._symmetric import wobble_rate as wobble_rate

_list_public_names(__name__)
