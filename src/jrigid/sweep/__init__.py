"""Functions over grids that are too large for memory or for one machine."""

from jrigid.sweep._sweep import sweep as sweep
from jrigid.sweep._sweep_result import Failure as Failure
from jrigid.sweep._sweep_result import SweepResult as SweepResult
