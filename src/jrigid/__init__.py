"""jrigid: the rotation of rigid bodies in JAX."""

from importlib.metadata import version as _version

from jrigid import datasets as datasets
from jrigid import rotation as rotation
from jrigid import torques as torques
from jrigid._checks import RESULTS as RESULTS
from jrigid._simulate import Trajectory as Trajectory
from jrigid._simulate import simulate as simulate
from jrigid.dynamics import State as State
from jrigid.dynamics import angular_momentum as angular_momentum
from jrigid.dynamics import bearing_torque as bearing_torque
from jrigid.dynamics import euler_equations as euler_equations
from jrigid.dynamics import kinetic_energy as kinetic_energy
from jrigid.systems import FloatingBody as FloatingBody
from jrigid.systems import FloatingState as FloatingState
from jrigid.systems import RigidBody as RigidBody

__version__ = _version("jrigid")
