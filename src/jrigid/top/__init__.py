"""The heavy top: Lagrange's in closed form, its nutation and special motions."""

from jrigid._public import list_public_names as _list_public_names
from jrigid.top._integrals import Integrals as Integrals
from jrigid.top._integrals import integrals as integrals
from jrigid.top._nutation import CLASSES as CLASSES
from jrigid.top._nutation import Advance as Advance
from jrigid.top._nutation import NutationBounds as NutationBounds
from jrigid.top._nutation import advance_per_nutation as advance_per_nutation
from jrigid.top._nutation import mean_precession as mean_precession
from jrigid.top._nutation import motion_class as motion_class
from jrigid.top._nutation import nutation_bounds as nutation_bounds
from jrigid.top._nutation import nutation_period as nutation_period
from jrigid.top._reduced import AngleRates as AngleRates
from jrigid.top._reduced import Conserved as Conserved
from jrigid.top._reduced import angle_rates as angle_rates
from jrigid.top._reduced import conserved as conserved
from jrigid.top._reduced import cubic as cubic
from jrigid.top._reduced import effective_potential as effective_potential
from jrigid.top._reduced import lagrangian as lagrangian
from jrigid.top._reduced import reduced_vector_field as reduced_vector_field
from jrigid.top._special import Gyroscopic as Gyroscopic
from jrigid.top._special import SteadyPrecession as SteadyPrecession
from jrigid.top._special import gyroscopic as gyroscopic
from jrigid.top._special import initial_state as initial_state
from jrigid.top._special import sleeping_spin as sleeping_spin
from jrigid.top._special import steady_precession as steady_precession
from jrigid.top._symmetric_top import SymmetricTop as SymmetricTop
from jrigid.top._top_motion import top_motion as top_motion

_list_public_names(__name__)
