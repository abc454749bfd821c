"""Light curves of rotating bodies: the brightness of a tumbler as it turns.

A body reflects sunlight. Its shape and its scattering law give its brightness for any
directions of the Sun and of the observer; the motion of the body turns these directions
in body axes. All functions are pure, and `jit`, `vmap` and derivatives work: of any
order, but for an ellipsoid at a phase angle of 0 of first order. Vectors to the Sun and
to the observer start at the body. They are in space axes where a state is given, and in
body axes where a shape alone is. Bodies are convex: nothing here casts a shadow.
`find_tumblers` goes the other way: it finds the tumblers that explain light curves.
`fit_shape` fits the convex shape and the surface of one of them. `find_spin` finds the
pole, the period and the convex shape of a body that rotates steadily.
"""

from jrigid._public import list_public_names as _list_public_names
from jrigid.photometry._alcdef import read_alcdef as read_alcdef
from jrigid.photometry._alias import Alias as Alias
from jrigid.photometry._alias import Estimates as Estimates
from jrigid.photometry._astropy import (
    geometry_of_coordinates as geometry_of_coordinates,
)
from jrigid.photometry._damit_files import LightCurve as LightCurve
from jrigid.photometry._damit_files import read_light_curves as read_light_curves
from jrigid.photometry._damit_files import read_shape as read_shape
from jrigid.photometry._ellipsoid import Ellipsoid as Ellipsoid
from jrigid.photometry._facets import Facets as Facets
from jrigid.photometry._facets import facets_from_mesh as facets_from_mesh
from jrigid.photometry._inversion import Inversion as Inversion
from jrigid.photometry._inversion import find_tumblers as find_tumblers
from jrigid.photometry._light_curve import brightness as brightness
from jrigid.photometry._light_curve import light_curve as light_curve
from jrigid.photometry._nights import NightPlan as NightPlan
from jrigid.photometry._periodogram import PeriodPairs as PeriodPairs
from jrigid.photometry._periodogram import period_pairs as period_pairs
from jrigid.photometry._pole import state_of_pole as state_of_pole
from jrigid.photometry._polyhedron import mesh_from_facets as mesh_from_facets
from jrigid.photometry._scattering import AbstractScattering as AbstractScattering
from jrigid.photometry._scattering import Geometric as Geometric
from jrigid.photometry._scattering import Lambert as Lambert
from jrigid.photometry._scattering import LommelSeeliger as LommelSeeliger
from jrigid.photometry._scattering import Mixture as Mixture
from jrigid.photometry._shape_fit import ShapeEstimates as ShapeEstimates
from jrigid.photometry._shape_fit import ShapeFit as ShapeFit
from jrigid.photometry._shape_fit import fit_shape as fit_shape
from jrigid.photometry._spin import Spin as Spin
from jrigid.photometry._spin import SpinEstimates as SpinEstimates
from jrigid.photometry._spin import SpinInversion as SpinInversion
from jrigid.photometry._spin import find_spin as find_spin
from jrigid.photometry._sun_and_earth import Orbit as Orbit
from jrigid.photometry._sun_and_earth import earth_position as earth_position
from jrigid.photometry._sun_and_earth import geometry_of_orbit as geometry_of_orbit
from jrigid.photometry._sun_and_earth import geometry_of_table as geometry_of_table
from jrigid.photometry._tumbler import Tumbler as Tumbler
from jrigid.photometry._tumbling import Tumbling as Tumbling
from jrigid.photometry._tumbling import omega_from_energy as omega_from_energy
from jrigid.photometry._tumbling import omega_from_periods as omega_from_periods
from jrigid.photometry._tumbling import tumbling as tumbling

_list_public_names(__name__)
