"""Inertia from what was observed: so far the numbers in which it is sought, and linear starts."""

from jrigid.identify._parameters import body_from_log_cholesky as body_from_log_cholesky
from jrigid.identify._parameters import inertia_from_parameters as inertia_from_parameters
from jrigid.identify._parameters import log_cholesky_from_body as log_cholesky_from_body
from jrigid.identify._parameters import parameters_from_inertia as parameters_from_inertia
from jrigid.identify._starts import LinearStart as LinearStart
from jrigid.identify._starts import gyrostat as gyrostat
from jrigid.identify._starts import momentum as momentum
from jrigid.identify._starts import weak_form as weak_form
