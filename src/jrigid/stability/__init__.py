"""Stability: growth rates, linearisation, maps, chaos, sections, final spin."""

from jrigid._public import list_public_names as _list_public_names
from jrigid.stability._closed import REGIONS as REGIONS
from jrigid.stability._closed import Modes as Modes
from jrigid.stability._closed import PrecessionStability as PrecessionStability
from jrigid.stability._closed import SatelliteStability as SatelliteStability
from jrigid.stability._closed import TopStability as TopStability
from jrigid.stability._closed import frequency as frequency
from jrigid.stability._closed import growth_rate as growth_rate
from jrigid.stability._closed import growth_rate_squared as growth_rate_squared
from jrigid.stability._closed import linearized as linearized
from jrigid.stability._closed import modes as modes
from jrigid.stability._closed import precession_stability as precession_stability
from jrigid.stability._closed import satellite_stability as satellite_stability
from jrigid.stability._closed import top_stability as top_stability
from jrigid.stability._eigen import eigenvalues as eigenvalues
from jrigid.stability._final_spin import SIDES as SIDES
from jrigid.stability._final_spin import FinalSpin as FinalSpin
from jrigid.stability._final_spin import final_spin as final_spin
from jrigid.stability._flip_time import flip_time as flip_time
from jrigid.stability._linearize import STABILITY as STABILITY
from jrigid.stability._linearize import Linearization as Linearization
from jrigid.stability._linearize import linearize as linearize
from jrigid.stability._lyapunov import ORDER as ORDER
from jrigid.stability._lyapunov import LyapunovSpectrum as LyapunovSpectrum
from jrigid.stability._lyapunov import Megno as Megno
from jrigid.stability._lyapunov import lyapunov_spectrum as lyapunov_spectrum
from jrigid.stability._lyapunov import megno as megno
from jrigid.stability._maps import boundary as boundary
from jrigid.stability._maps import stability_map as stability_map
from jrigid.stability._section import Section as Section
from jrigid.stability._section import poincare_section as poincare_section

_list_public_names(__name__)
