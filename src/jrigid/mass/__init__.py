"""Mass properties of points, densities and meshes; parallel and principal axes.

Positions, centres of mass and tensors are components in one set of body axes [m, kg, kg
m^2]. `MassProperties` holds its tensor about the centre of mass. Where moments repeat,
derivatives of their symmetric functions are right to first order through
`principal_axes`, and to second order through `tensor_function`.
"""

from jrigid._public import list_public_names as _list_public_names
from jrigid.mass._axes import inertia_of_second_moment as inertia_of_second_moment
from jrigid.mass._axes import parallel_axis as parallel_axis
from jrigid.mass._axes import principal_axes as principal_axes
from jrigid.mass._axes import second_moment as second_moment
from jrigid.mass._axes import tensor_function as tensor_function
from jrigid.mass._axes import to_center_of_mass as to_center_of_mass
from jrigid.mass._mass_body import MassProperties as MassProperties
from jrigid.mass._mass_body import PrincipalAxes as PrincipalAxes
from jrigid.mass._mesh import from_mesh as from_mesh
from jrigid.mass._points import from_density as from_density
from jrigid.mass._points import from_points as from_points
from jrigid.mass._points import inertia_tensor as inertia_tensor

_list_public_names(__name__)
