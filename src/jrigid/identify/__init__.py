"""Inertia from observations: the fit, plans, unknown numbers and linear estimates."""

from jrigid._public import list_public_names as _list_public_names
from jrigid.identify._compare import Comparison as Comparison
from jrigid.identify._compare import compare as compare
from jrigid.identify._compare import cross_validate as cross_validate
from jrigid.identify._design import Bound as Bound
from jrigid.identify._design import Plan as Plan
from jrigid.identify._design import profile as profile
from jrigid.identify._design import residuals as residuals
from jrigid.identify._diagnostics import Diagnostics as Diagnostics
from jrigid.identify._disturbance import GaussMarkov as GaussMarkov
from jrigid.identify._fit import fit as fit
from jrigid.identify._fit import fit_each as fit_each
from jrigid.identify._inertia_models import AbstractInertiaModel as AbstractInertiaModel
from jrigid.identify._inertia_models import Fixed as Fixed
from jrigid.identify._inertia_models import Flat as Flat
from jrigid.identify._inertia_models import LogCholesky as LogCholesky
from jrigid.identify._inertia_models import Moments as Moments
from jrigid.identify._inertia_models import Symmetric as Symmetric
from jrigid.identify._inertia_models import Tensor as Tensor
from jrigid.identify._inertia_models import Top as Top
from jrigid.identify._noise import block_bootstrap as block_bootstrap
from jrigid.identify._noise import coloured_covariance as coloured_covariance
from jrigid.identify._optimal import Optimum as Optimum
from jrigid.identify._optimal import optimal_trial as optimal_trial
from jrigid.identify._parameters import body_from_log_cholesky as body_from_log_cholesky
from jrigid.identify._parameters import (
    inertia_from_parameters as inertia_from_parameters,
)
from jrigid.identify._parameters import log_cholesky_from_body as log_cholesky_from_body
from jrigid.identify._parameters import (
    parameters_from_inertia as parameters_from_inertia,
)
from jrigid.identify._records import AngularMomenta as AngularMomenta
from jrigid.identify._records import Attitudes as Attitudes
from jrigid.identify._records import Directions as Directions
from jrigid.identify._records import Observed as Observed
from jrigid.identify._records import Rates as Rates
from jrigid.identify._records import Record as Record
from jrigid.identify._result import FitResult as FitResult
from jrigid.identify._result import Status as Status
from jrigid.identify._sample import LogDensity as LogDensity
from jrigid.identify._sample import log_density as log_density
from jrigid.identify._save import load as load
from jrigid.identify._save import save as save
from jrigid.identify._sensors import AbstractSensor as AbstractSensor
from jrigid.identify._sensors import Accelerometer as Accelerometer
from jrigid.identify._sensors import AttitudeSensor as AttitudeSensor
from jrigid.identify._sensors import DirectionSensor as DirectionSensor
from jrigid.identify._sensors import FunctionSensor as FunctionSensor
from jrigid.identify._sensors import Gyro as Gyro
from jrigid.identify._sensors import Magnetometer as Magnetometer
from jrigid.identify._sensors import MomentumSensor as MomentumSensor
from jrigid.identify._starts import LinearEstimate as LinearEstimate
from jrigid.identify._starts import gyrostat as gyrostat
from jrigid.identify._starts import momentum as momentum
from jrigid.identify._starts import weak_form as weak_form
from jrigid.identify._train import TrainResult as TrainResult
from jrigid.identify._train import train as train
from jrigid.identify._unknowns import each as each
from jrigid.identify._unknowns import prior as prior

_list_public_names(__name__)
