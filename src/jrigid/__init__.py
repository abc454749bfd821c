"""jrigid: the rotation of rigid bodies in JAX."""

from importlib import import_module as _import_module
from importlib.metadata import version as _version
from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

from jrigid import datasets as datasets
from jrigid import dynamics as dynamics
from jrigid import elliptic as elliptic
from jrigid import free as free
from jrigid import lagrangian as lagrangian
from jrigid import mass as mass
from jrigid import rotation as rotation
from jrigid import solids as solids
from jrigid import solvers as solvers
from jrigid import systems as systems
from jrigid import top as top
from jrigid import torques as torques
from jrigid._checks import RESULTS as RESULTS
from jrigid.dynamics import ExactStates as ExactStates
from jrigid.dynamics import State as State
from jrigid.dynamics import angular_momentum as angular_momentum
from jrigid.dynamics import bearing_torque as bearing_torque
from jrigid.dynamics import euler_equations as euler_equations
from jrigid.dynamics import kinetic_energy as kinetic_energy
from jrigid.free import free_rotation as free_rotation
from jrigid.mass import MassProperties as MassProperties
from jrigid.mass import PrincipalAxes as PrincipalAxes
from jrigid.mass import from_density as from_density
from jrigid.mass import from_mesh as from_mesh
from jrigid.mass import from_points as from_points
from jrigid.mass import inertia_tensor as inertia_tensor
from jrigid.mass import parallel_axis as parallel_axis
from jrigid.mass import principal_axes as principal_axes
from jrigid.mass import tensor_function as tensor_function
from jrigid.mass import to_center_of_mass as to_center_of_mass
from jrigid.simulate import Trajectory as Trajectory
from jrigid.simulate import simulate as simulate
from jrigid.sweep import SweepResult as SweepResult
from jrigid.sweep import sweep as sweep
from jrigid.systems import AbstractSystem as AbstractSystem
from jrigid.systems import FloatingBody as FloatingBody
from jrigid.systems import FloatingState as FloatingState
from jrigid.systems import RigidBody as RigidBody
from jrigid.top import SymmetricTop as SymmetricTop
from jrigid.top import top_motion as top_motion

__version__ = _version("jrigid")

# These are imported when they are first used: they take two thirds of the time.
_LATE = ("identify", "io", "photometry", "plot", "records", "stability")
if _TYPE_CHECKING:
    from jrigid import identify as identify
    from jrigid import io as io
    from jrigid import photometry as photometry
    from jrigid import plot as plot
    from jrigid import records as records
    from jrigid import stability as stability
else:
    # To a type checker such a function would make every name valid.
    def __getattr__(name: str) -> _Any:
        """Import a package at its first use."""
        if name in _LATE:
            return _import_module(f"{__name__}.{name}")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__() -> list[str]:
        """All names, those of packages that are not imported yet among them."""
        return sorted({*globals(), *_LATE})

    globals()["__all__"] = [name for name in __dir__() if not name.startswith("_")]
