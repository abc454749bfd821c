"""Inertia from what was observed: the fit, what it can tell, its numbers and its linear starts."""

from jrigid.identify._design import Bound as Bound
from jrigid.identify._design import cramer_rao as cramer_rao
from jrigid.identify._design import fisher_information as fisher_information
from jrigid.identify._design import identifiability as identifiability
from jrigid.identify._design import profile as profile
from jrigid.identify._design import residuals as residuals
from jrigid.identify._fit import fit as fit
from jrigid.identify._noise import block_bootstrap as block_bootstrap
from jrigid.identify._noise import coloured_covariance as coloured_covariance
from jrigid.identify._observations import AbstractObservation as AbstractObservation
from jrigid.identify._observations import AngularMomenta as AngularMomenta
from jrigid.identify._observations import Attitudes as Attitudes
from jrigid.identify._observations import Directions as Directions
from jrigid.identify._observations import Observed as Observed
from jrigid.identify._observations import Rates as Rates
from jrigid.identify._parameters import LogCholesky as LogCholesky
from jrigid.identify._parameters import body_from_log_cholesky as body_from_log_cholesky
from jrigid.identify._parameters import inertia_from_parameters as inertia_from_parameters
from jrigid.identify._parameters import log_cholesky_from_body as log_cholesky_from_body
from jrigid.identify._parameters import parameters_from_inertia as parameters_from_inertia
from jrigid.identify._result import FitResult as FitResult
from jrigid.identify._result import Status as Status
from jrigid.identify._starts import LinearStart as LinearStart
from jrigid.identify._starts import gyrostat as gyrostat
from jrigid.identify._starts import momentum as momentum
from jrigid.identify._starts import weak_form as weak_form
