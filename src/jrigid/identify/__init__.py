"""Inertia from what was observed: the fit, what it can tell, its numbers and its linear starts."""

from jrigid.identify._design import (
    Bound,
    cramer_rao,
    fisher_information,
    identifiability,
    profile,
    residuals,
)
from jrigid.identify._fit import fit
from jrigid.identify._noise import block_bootstrap, coloured_covariance
from jrigid.identify._observations import (
    AbstractObservation,
    AngularMomenta,
    Attitudes,
    Directions,
    Observed,
    Rates,
)
from jrigid.identify._parameters import (
    LogCholesky,
    body_from_log_cholesky,
    inertia_from_parameters,
    log_cholesky_from_body,
    parameters_from_inertia,
)
from jrigid.identify._result import FitResult, Status
from jrigid.identify._starts import LinearStart, gyrostat, momentum, weak_form

__all__ = [
    "AbstractObservation",
    "AngularMomenta",
    "Attitudes",
    "Bound",
    "Directions",
    "FitResult",
    "LinearStart",
    "LogCholesky",
    "Observed",
    "Rates",
    "Status",
    "block_bootstrap",
    "body_from_log_cholesky",
    "coloured_covariance",
    "cramer_rao",
    "fisher_information",
    "fit",
    "gyrostat",
    "identifiability",
    "inertia_from_parameters",
    "log_cholesky_from_body",
    "momentum",
    "parameters_from_inertia",
    "profile",
    "residuals",
    "weak_form",
]


def __dir__() -> list[str]:
    return __all__
