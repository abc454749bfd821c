"""Torques on a body: composable, added with `+` and `sum()`.

A torque is any callable `(t, state, args) -> (3,)` body components [N m]. The classes
here add a potential energy, and internal parts (a damper, a rotor) with a state, an
angular momentum and an energy of their own. A parameter of the wrong sign raises an
error when the torque is built, if its value is known then. `simulate` and other
functions that integrate check all parameters.
"""

from jrigid._public import list_public_names as _list_public_names
from jrigid.torques._base import AbstractTorque as AbstractTorque
from jrigid.torques._base import Constant as Constant
from jrigid.torques._base import Sum as Sum
from jrigid.torques._base import Torque as Torque
from jrigid.torques._base import TorqueFunction as TorqueFunction
from jrigid.torques._base import as_torque as as_torque
from jrigid.torques._external import CoulombFriction as CoulombFriction
from jrigid.torques._external import GravityGradient as GravityGradient
from jrigid.torques._external import LinearDrag as LinearDrag
from jrigid.torques._external import MagneticDipole as MagneticDipole
from jrigid.torques._external import QuadraticDrag as QuadraticDrag
from jrigid.torques._external import SolarPressure as SolarPressure
from jrigid.torques._external import UniformGravity as UniformGravity
from jrigid.torques._internal import InternalDamper as InternalDamper
from jrigid.torques._internal import Rotor as Rotor
from jrigid.torques._internal import SpinningMass as SpinningMass
from jrigid.torques._orbit import KeplerOrbit as KeplerOrbit
from jrigid.torques._sampled import Sampled as Sampled

_list_public_names(__name__)
