"""Functions over grids that are too large for memory or for one machine."""

from jrigid.sweep._result import Failure as Failure
from jrigid.sweep._result import SweepResult as SweepResult
from jrigid.sweep._sweep import sweep as sweep
