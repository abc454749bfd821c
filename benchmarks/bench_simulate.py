"""One simulate() call and its gradient beside scipy and hand-written diffrax.

A tumbling body, I = (1, 2, 3), 100 turns. Beside each time stands the error, against a
run at the tightest tolerance: contenders are to be compared at equal error, not at
equal rtol.
"""

import functools

import common
import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate

import jrigid as jr

MOMENTS = np.array([1.0, 2.0, 3.0])
ATTITUDE = np.array([1.0, 0.0, 0.0, 0.0])
OMEGA = np.array([0.3, 0.5, 0.8])
END = float(200 * np.pi / np.linalg.norm(OMEGA))


def ours(rtol, adjoint=None):
    def final(omega):
        trajectory = jr.simulate(
            jr.RigidBody(MOMENTS),
            jr.State(ATTITUDE, omega),
            END,
            rtol=rtol,
            adjoint=adjoint,
        )
        return jnp.concatenate([trajectory.states.attitude, trajectory.states.omega])

    return final


def field(_t, y, args):
    """What a user of diffrax writes: the seven right-hand sides in one array."""
    w, x, y_, z, a, b, c = y
    i1, i2, i3 = args
    return jnp.stack(
        [
            0.5 * (-x * a - y_ * b - z * c),
            0.5 * (w * a + y_ * c - z * b),
            0.5 * (w * b + z * a - x * c),
            0.5 * (w * c + x * b - y_ * a),
            (i2 - i3) / i1 * b * c,
            (i3 - i1) / i2 * c * a,
            (i1 - i2) / i3 * a * b,
        ]
    )


def by_hand(rtol, adjoint=None):
    if adjoint is None:
        adjoint = diffrax.RecursiveCheckpointAdjoint()

    def final(omega):
        y0 = jnp.concatenate([jnp.asarray(ATTITUDE), omega])
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            diffrax.Dopri8(),
            0.0,
            END,
            0.01,
            y0,
            jnp.asarray(MOMENTS),
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
            adjoint=adjoint,
            max_steps=2**17,
        )
        return jnp.asarray(solution.ys)[0]

    return final


def scipy_final(rtol):
    def right(_t, y):
        w, x, y_, z, a, b, c = y
        return [
            0.5 * (-x * a - y_ * b - z * c),
            0.5 * (w * a + y_ * c - z * b),
            0.5 * (w * b + z * a - x * c),
            0.5 * (w * c + x * b - y_ * a),
            -1.0 * b * c,
            1.0 * c * a,
            -1.0 / 3.0 * a * b,
        ]

    def final(omega):
        y0 = np.concatenate([ATTITUDE, omega])
        return scipy.integrate.solve_ivp(
            right, (0, END), y0, method="DOP853", rtol=rtol, atol=rtol
        ).y[:, -1]

    return final


def error(y, exact):
    """Largest error of a component; q and -q are the same attitude."""
    y, flip = np.asarray(y), np.array([-1] * 4 + [1] * 3)
    return float(min(np.abs(y - exact).max(), np.abs(y * flip - exact).max()))


def component(final, omega):
    """A scalar to differentiate: the first component of omega at the end."""
    return final(omega)[4]


CONTENDERS = (
    ("jrigid.simulate, default (rtol 1e-8)", ours, 1e-8),
    ("hand-written diffrax, Dopri8, rtol 1e-8", by_hand, 1e-8),
    ("hand-written diffrax, Dopri8, rtol 1e-11", by_hand, 1e-11),
)


def differences(final):
    """Central differences, one column of the Jacobian for each component of omega."""
    steps = 1e-5 * np.eye(3)
    return [(final(OMEGA + d) - final(OMEGA - d)) / 2e-5 for d in steps]


def main():
    options = common.arguments(__doc__).parse_args()
    omega = jnp.asarray(OMEGA)
    exact = np.asarray(jax.jit(ours(1e-14))(omega))
    exact_jacobian = np.asarray(
        jax.jit(jax.jacfwd(ours(1e-13, diffrax.ForwardMode())))(omega)
    )
    compile_times, cases = {}, {"value": {}, "gradient": {}, "Jacobian": {}}
    for name, make, rtol in CONTENDERS:
        programs = {
            "value": make(rtol),
            "gradient": jax.grad(functools.partial(component, make(rtol))),
            "Jacobian": jax.jacfwd(make(rtol, diffrax.ForwardMode())),
        }
        for what, function in programs.items():
            program, compile_times[what, name] = common.compiled(function, omega)
            cases[what][name] = lambda program=program: program(omega)
    eager = ours(1e-8)
    cases["value"]["jrigid.simulate, default, eager call"] = lambda: eager(omega)
    for rtol in (1e-8, 1e-11):
        final, name = scipy_final(rtol), f"scipy solve_ivp, DOP853, rtol {rtol:.0e}"
        cases["value"][name] = lambda final=final: final(OMEGA)
        cases["Jacobian"][f"{name}, six differences"] = lambda final=final: differences(
            final
        )
    rows = []
    for what, contenders in cases.items():
        for name, (low, middle, answer) in common.timed(contenders, repeats=9).items():
            if what == "value":
                off = error(answer, exact)
            elif what == "gradient":
                off = np.linalg.norm(answer - exact_jacobian[4]) / np.linalg.norm(
                    exact_jacobian[4]
                )
            else:
                columns = (
                    np.asarray(answer)
                    if "scipy" not in name
                    else np.stack(answer, axis=1)
                )
                off = np.linalg.norm(columns - exact_jacobian) / np.linalg.norm(
                    exact_jacobian
                )
            rows.append(
                (what, name, compile_times.get((what, name)), low, middle, float(off))
            )
    header = ["what", "who", "compile ms", "min ms", "median ms", "error"]
    text = "100 turns of a tumbling body, I = (1, 2, 3), attitude and rates.\n\n"
    packages = ("jax", "diffrax", "numpy", "scipy")
    text += common.table(header, rows)
    common.report(
        "simulate",
        "One call of simulate and its derivatives",
        text,
        packages,
        options.write,
    )


if __name__ == "__main__":
    main()
