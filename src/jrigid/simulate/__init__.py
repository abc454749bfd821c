"""Integrated motion: the call, and the trajectory it gives."""

from jrigid.simulate._simulate import simulate as simulate
from jrigid.simulate._trajectory import Trajectory as Trajectory
