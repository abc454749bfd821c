"""Interoperability: attitudes, meshes, inertials and tables of other packages.

What these functions return is in SI units, with attitudes scalar first and body to
space, and tensors about the centre of mass. Each function states the conventions of the
other package. The packages are the extra `jrigid[io]`.
"""

from jrigid._public import list_public_names as _list_public_names
from jrigid.io._attitudes import from_jaxlie as from_jaxlie
from jrigid.io._attitudes import from_mrp as from_mrp
from jrigid.io._attitudes import from_scipy as from_scipy
from jrigid.io._attitudes import from_spice as from_spice
from jrigid.io._attitudes import shadow_mrp as shadow_mrp
from jrigid.io._attitudes import to_jaxlie as to_jaxlie
from jrigid.io._attitudes import to_mrp as to_mrp
from jrigid.io._attitudes import to_scipy as to_scipy
from jrigid.io._attitudes import to_spice as to_spice
from jrigid.io._inertials import read_inertials as read_inertials
from jrigid.io._inertials import write_inertials as write_inertials
from jrigid.io._meshes import from_trimesh as from_trimesh
from jrigid.io._meshes import mesh_arrays as mesh_arrays
from jrigid.io._meshes import read_mesh as read_mesh
from jrigid.io._physical import diagnose as diagnose
from jrigid.io._physical import nearest_physical as nearest_physical
from jrigid.io._tables import to_pandas as to_pandas
from jrigid.io._tables import to_xarray as to_xarray

_list_public_names(__name__)
