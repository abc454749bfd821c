r"""Rotations: quaternions, matrices, angles, rates, interpolation, dead reckoning.

An attitude is a unit quaternion, scalar first (w, x, y, z), that takes body components
to space components: `v_space = R(q) v_body`. `omega` is the angular velocity in body
components [rad/s], `hat(omega) = R^T R'`. q and -q are the same attitude.
"""

from jrigid._public import list_public_names as _list_public_names
from jrigid.rotation._forms import from_euler as from_euler
from jrigid.rotation._forms import from_matrix as from_matrix
from jrigid.rotation._forms import from_roll_pitch_yaw as from_roll_pitch_yaw
from jrigid.rotation._forms import from_scipy as from_scipy
from jrigid.rotation._forms import hat as hat
from jrigid.rotation._forms import to_euler as to_euler
from jrigid.rotation._forms import to_matrix as to_matrix
from jrigid.rotation._forms import to_roll_pitch_yaw as to_roll_pitch_yaw
from jrigid.rotation._forms import to_scipy as to_scipy
from jrigid.rotation._forms import vee as vee
from jrigid.rotation._quaternion import angle_between as angle_between
from jrigid.rotation._quaternion import conjugate as conjugate
from jrigid.rotation._quaternion import exp as exp
from jrigid.rotation._quaternion import from_axis_angle as from_axis_angle
from jrigid.rotation._quaternion import identity as identity
from jrigid.rotation._quaternion import inverse as inverse
from jrigid.rotation._quaternion import log as log
from jrigid.rotation._quaternion import multiply as multiply
from jrigid.rotation._quaternion import normalize as normalize
from jrigid.rotation._quaternion import random as random
from jrigid.rotation._quaternion import rotate as rotate
from jrigid.rotation._quaternion import rotate_inverse as rotate_inverse
from jrigid.rotation._quaternion import slerp as slerp
from jrigid.rotation._rates import angular_velocity as angular_velocity
from jrigid.rotation._rates import attitude_rate as attitude_rate
from jrigid.rotation._rates import euler_rates_to_omega as euler_rates_to_omega
from jrigid.rotation._rates import integrate_rate as integrate_rate
from jrigid.rotation._rates import omega_to_euler_rates as omega_to_euler_rates

_list_public_names(__name__)
