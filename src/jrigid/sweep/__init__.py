"""Functions over grids too large for memory or one machine: blocks, executors, a store."""

from jrigid.sweep._result import Failure as Failure
from jrigid.sweep._result import SweepResult as SweepResult
from jrigid.sweep._sweep import sweep as sweep
