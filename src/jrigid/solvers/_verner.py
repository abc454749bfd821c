"""Verner's Runge-Kutta pair of orders 9 and 8."""

from collections.abc import Callable
from typing import ClassVar

import diffrax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree

from jrigid._numerics import product
from jrigid._types import TimeLike
from jrigid.solvers._dense import Dense

# The tables are aligned by hand, with many numbers on a line.
# fmt: off
# Fractions of the step at which the stages are, from the second one on.
_C = [
    0.03462, 0.09702435063878044, 0.14553652595817068, 0.561, 0.229007911590485,
    0.544992088409515, 0.645, 0.48375, 0.06757, 0.25, 0.6590650618730999, 0.8206,
    0.9012, 1.0, 1.0, 1.0,
]
# Coefficients of the stages from the second one on. Each entry has the number of a
# stage and coefficients: of the first stage, then of this stage and those after it.
_ROWS = [
    (2, [0.03462]),
    (2, [-0.03893354388572874, 0.13595789452450918]),
    (3, [0.036384131489542684, 0.109152394468628]),
    (3, [2.02576391439397, -7.638023836496292, 6.173259922102322]),
    (4, [0.05112275589406061, 0.17708237945550215, 0.0008027762409222455]),
    (4, [
        0.13160063579752163, -0.29572762526696367, 0.0878137803564295,
        0.6213052975225275,
    ]),
    (6, [0.07166666666666668, 0.33055335789153195, 0.24277997544180138]),
    (6, [
        0.071806640625, 0.3294380283228177, 0.11651900292718229, -0.034013671874999984,
    ]),
    (6, [
        0.04836757646340647, 0.03928989925676164, 0.10547409458903446,
        -0.02143865284648313, -0.10412291746271944,
    ]),
    (6, [
        -0.02664561487201479, 0.03333333333333333, -0.1631072244872467,
        0.033960816841277615, 0.1572319413814626, 0.21522674780318796,
    ]),
    (6, [
        0.036890092487086225, -0.1465181576725543, 0.22425777681720244,
        0.022944057170660725, -0.003585005290572825, 0.08669223316444385,
        0.43838406519683376,
    ]),
    (6, [
        -0.48660122151133406, -6.304602650282853, -0.28124561828947187,
        -2.6790192362198493, 0.5188156639241576, 1.3653531876033418, 5.8850910885039465,
        2.8028087862720628,
    ]),
    (6, [
        0.41853674577534716, 6.724547581906459, -0.4254442801646118, 3.3432791530012658,
        0.6170816631175378, -0.9299661239399328, -6.099948804751011, -3.002206187889399,
        0.2553202529443446,
    ]),
    (6, [
        -0.7793740861228846, -13.937342538107776, 1.2520488533793572,
        -14.69150040801687, -0.4947050585331417, 2.2429749091462368, 13.367893803828643,
        14.396650486650687, -0.79758133317768, 0.4409353709534279,
    ]),
    (6, [
        2.0580513374668863, 22.357937727968032, 0.9094981099755641, 35.89110098240264,
        -3.4425150276244536, -4.8654813580363685, -18.909803813543427,
        -34.26354448030452, 1.2647565216956427,
    ]),
    (8, [
        0.014611976858423126, -0.3915211862331339, 0.23109325002895065,
        0.12747667699928525, 0.2246434176204158, 0.5684352689748513,
        0.058258715572158275, 0.13643174034822156, 0.030570139830827976,
    ]),
]
_ERROR = (8, [
        -0.005357988290444466, -2.583020491182464, 0.14252253154686625,
        0.013420653512688676, -0.028672962914094935, 2.624999655215792,
        -0.2825509643291537, 0.13643174034822156, 0.030570139830827976,
        -0.048342313738239585,
])
# Dense output of order 6: the weights of stages 1, 8 to 15 and 17 in Chebyshev
# polynomials.
_DENSE = [
    [
        0.014875428560454304, 0.0007655025021676208, 0.0012315376022196023,
        0.0011406891502607078, -0.003095452399788275, 0.0010675727882038803,
        -0.005705525333674056, 0.004332223988579367,
    ],
    [
        -0.1079593104301497, -0.24233508789235803, 0.006202696313135945,
        0.19362973866363037, -0.16796662293656858, -0.23772393293432542,
        0.07396264393701538, 0.09066868904648613,
    ],
    [
        0.11285550805238329, 0.1453572671767153, -0.014990728221071304,
        -0.06537067606805767, 0.028829175685479744, 0.05414428516455266,
        -0.011147330502316408, -0.018584251258734953,
    ],
    [
        0.10478922600914613, 0.040479076528787995, -0.03923890448120308,
        0.02521418525912088, -0.011109350347181378, 0.007150645947326216,
        0.009297367318880955, -0.009105569235592477,
    ],
    [
        0.1516531295529033, 0.12464030321833344, -0.05701564454479523,
        0.0050842981557684365, 0.020428473934820605, -0.028430947875439858,
        -0.0027442501327208, 0.011028055311545859,
    ],
    [
        0.17675072556765, 0.34953049245652834, 0.03956263261848988, -0.1978972346664801,
        0.13014022386601234, 0.21104540994290416, -0.06223594756472658,
        -0.07846103324552677,
    ],
    [
        0.01882576595361587, 0.026397890432053837, 0.021615149576689505,
        0.00833114658166245, -0.016037774024269338, -0.007208586353633522,
        0.004726216280043093, 0.0016089071259963708,
    ],
    [
        0.02633770587500215, 0.051575844286542986, 0.03834708731548158,
        0.025507616660401418, 0.014025356033625008, -0.006390314734945486,
        -0.010494279049997958, -0.002477276037888135,
    ],
    [
        0.0028527717875177004, 0.007111311695419024, 0.0067473279994068915,
        0.012974912476265046, 0.011582411831162289, -0.004640459773976234,
        -0.0058974417026728945, -0.0001606944822938485,
    ],
    [
        -0.0009809509285230655, -0.0035226004041905134, -0.002461154178353794,
        -0.00861467621257154, -0.006796441643292412, 0.010986327829333592,
        0.010238546750169272, 0.0011509487874284605,
    ],
]
# fmt: on
_DENSE_STAGES = np.array([1, *range(8, 16), 17]) - 1


def _row(start: int, coefficients: list[float], length: int) -> np.ndarray:
    """A row of the tableau, from an entry of the tables above."""
    row = np.zeros(length)
    row[0] = coefficients[0]
    # The tables count stages from 1.
    row[start - 1 : start - 2 + len(coefficients)] = coefficients[1:]
    return row


_A = tuple(_row(*row, length) for length, row in enumerate(_ROWS, 1))
# The last stage is at the new state, so its row is also that of the solution.
_TABLEAU = diffrax.ButcherTableau(
    c=np.array(_C), a_lower=_A, b_sol=np.append(_A[-1], 0.0), b_error=_row(*_ERROR, 17)
)


class _Interpolation(Dense):
    """Dense output of order 6, with a continuous slope, from the stages alone."""

    t0: TimeLike
    t1: TimeLike
    y0: PyTree
    y1: PyTree
    k: PyTree[Float[Array, "stages ..."]]

    def at(self, t: TimeLike) -> PyTree:
        """The state at t."""
        # The loop of diffrax takes steps of length zero in finished lanes.
        step = jnp.asarray(self.t1 - self.t0)
        none = step == 0
        x = 2 * jnp.where(none, 0.0, t - self.t0) / jnp.where(none, 1.0, step) - 1
        # Chebyshev polynomials from -1 to 1: T_(n+1) = 2 x T_n - T_(n-1).
        polynomials = [jnp.ones_like(x), x]
        for _ in range(6):
            polynomials.append(2 * x * polynomials[-1] - polynomials[-2])
        coefficients = jnp.asarray(_DENSE, x.dtype)
        weights = product("sp,p->s", coefficients, jnp.stack(polynomials))

        def moved(y0: Array, k: Array) -> Array:
            of_stages = product(
                "s,s...->...", weights.astype(y0.dtype), k[_DENSE_STAGES]
            )
            return y0 + of_stages

        return jtu.tree_map(moved, self.y0, self.k)


class Verner9(diffrax.AbstractERK):
    """Verner's method of order 9, error estimate of order 8.

    It is the default of `jrigid.simulate`. A step takes 16 evaluations of the vector
    field, since its last stage is the first stage of the next step. The dense output,
    of order 6 with a continuous slope, takes no further evaluations.

    Gradients: those of the method.
    Source: J. H. Verner, Numer. Algorithms 53 (2010) 383, the "most efficient" pair of
    orders 9 and 8; the dense output is the combination of its stages whose terms of
    order 7 are smallest.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.01, 1.0, 0.0]))
    >>> solver = jr.solvers.Verner9()
    >>> motion = jr.simulate(body, state0, 100.0, solver=solver, rtol=1e-13)
    >>> print(abs(motion.energy - 1.00005) < 1e-12)
    True
    """

    tableau: ClassVar[diffrax.ButcherTableau] = _TABLEAU
    interpolation_cls: ClassVar[Callable[..., _Interpolation]] = _Interpolation

    def order(self, terms: PyTree) -> int:
        """Order of the method, 9."""
        del terms
        return 9
