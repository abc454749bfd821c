"""Fits of the inertia to a gyro that jrigid's is measured beside: finite differences.

Each is given what it cannot find: a start near the truth (tensor and first rates), the
noise, and that the body is free. All have the same eight unknowns: five of the tensor
by the logarithmic Cholesky factor of the second moments of mass (the trace is no news
of a free body) and three rates at the first time.

`fit_scipy` is `scipy.optimize.least_squares` over `solve_ivp`; `fit_mujoco` is MuJoCo's
own Gauss-Newton, `mujoco.minimize.least_squares`, over its rollouts; `fit_sysid` the
same by its toolbox of system identification, `mujoco.sysid`, as its examples use it
(pip's `mujoco[sysid]`).

    python benchmarks/peers_identify.py

prints how they do on 200 samples of 10 turns with 1 % noise from three starts.
"""

import argparse
import contextlib
import importlib
import io
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

_LARGEST_TURN = (
    0.1  # [rad] of a step of MuJoCo's Runge-Kutta: its error is far below 1e-4
)
_FREE_BODY = """<mujoco><option integrator="RK4" gravity="0 0 0">
<flag constraint="disable" contact="disable"/></option>
<worldbody><body name="body"><joint name="ball" type="ball"/>
<inertial pos="0 0 0" mass="1" fullinertia="1 1 1 0 0 0"/></body></worldbody>
<sensor><ballangvel name="gyro" joint="ball"/></sensor></mujoco>"""


@dataclass(frozen=True)
class PeerFit:
    """What a peer found.

    Attributes:
        tensor: Inertia (3, 3), mean moment 1.
        omega0: Rates at the first time [rad/s].
        chi_square: Sum of squares of residuals over the noise.
        seconds: Of the whole fit.
        evaluations: Motions that were integrated.
    """

    tensor: np.ndarray
    omega0: np.ndarray
    chi_square: float
    seconds: float
    evaluations: int


def numbers_of(tensor: np.ndarray) -> np.ndarray:
    """Five numbers of a tensor up to its size: the factor L of second moments."""
    tensor = np.asarray(tensor, float)
    factor = np.linalg.cholesky(np.trace(tensor) / 2 * np.eye(3) - tensor)
    factor = factor / factor[2, 2]
    return np.array(
        [np.log(factor[0, 0]), np.log(factor[1, 1]), *factor[[1, 2, 2], [0, 0, 1]]]
    )


def tensor_of(numbers: np.ndarray) -> np.ndarray:
    """The tensor of mean moment 1 (..., 3, 3) of the five numbers (..., 5)."""
    factor = np.zeros((*numbers.shape[:-1], 3, 3))
    factor[..., [0, 1], [0, 1]] = np.exp(numbers[..., :2])
    factor[..., [1, 2, 2], [0, 0, 1]] = numbers[..., 2:]
    factor[..., 2, 2] = 1.0
    second = factor @ np.swapaxes(factor, -1, -2)
    trace = np.trace(second, axis1=-2, axis2=-1)[..., None, None]
    return 1.5 * (np.eye(3) - second / trace)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of rows (n, 3); numpy's takes ten times longer on so few."""
    return np.stack(
        [
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ],
        axis=1,
    )


def _motions(ts: np.ndarray, unknowns: np.ndarray) -> np.ndarray:
    """Rates (n, samples, 3) of unknowns (n, 8), by one DOP853 over all of them."""
    tensor, omega0 = tensor_of(unknowns[:, :5]), unknowns[:, 5:]
    inverse, momentum0 = np.linalg.inv(tensor), (tensor @ omega0[..., None])[..., 0]
    shape = omega0.shape

    def rates(_t: float, flat: np.ndarray) -> np.ndarray:
        momentum = flat.reshape(shape)
        return _cross(momentum, (inverse @ momentum[..., None])[..., 0]).ravel()

    done = solve_ivp(
        rates,
        (ts[0], ts[-1]),
        momentum0.ravel(),
        "DOP853",
        ts,
        rtol=1e-9,
        atol=1e-9 * np.max(np.abs(momentum0)),
    )
    momentum = np.moveaxis(done.y.reshape(*shape, len(ts)), -1, 1)
    return momentum @ np.swapaxes(inverse, -1, -2)


def fit_scipy(
    ts: np.ndarray,
    omegas: np.ndarray,
    sigma: float,
    start: tuple[np.ndarray, np.ndarray],
) -> PeerFit:
    """`scipy.optimize.least_squares`; one integration runs a Jacobian's nine motions.

    Args:
        ts: Times of the readings (samples,) [s].
        omegas: Readings (samples, 3) [rad/s].
        sigma: Their standard deviation [rad/s].
        start: Tensor (3, 3) of any size, and rates (3,) at the first time.
    """
    begin = time.perf_counter()
    x0 = np.concatenate([numbers_of(start[0]), start[1]])
    scale = np.concatenate([np.ones(5), np.full(3, np.linalg.norm(start[1]))])

    evaluations = 0

    def residuals(x: np.ndarray) -> np.ndarray:
        nonlocal evaluations
        rows = np.atleast_2d(x)
        evaluations += len(rows)
        return ((_motions(ts, rows) - omegas) / sigma).reshape(*x.shape[:-1], -1)

    def slopes(x: np.ndarray) -> np.ndarray:
        shifted = residuals(
            x + np.concatenate([np.zeros((1, 8)), 1e-6 * np.diag(scale)])
        )
        return ((shifted[1:] - shifted[0]) / (1e-6 * scale)[:, None]).T

    jac: Any = slopes  # scipy's annotation knows its names alone
    done = least_squares(residuals, x0, jac, x_scale=scale, method="trf", max_nfev=200)
    seconds = time.perf_counter() - begin
    return PeerFit(
        tensor_of(done.x[:5]), done.x[5:], float(2 * done.cost), seconds, evaluations
    )


def _spec_with(spec: Any, numbers: np.ndarray) -> Any:
    """MuJoCo's specification with another inertia; its compiler takes the axes."""
    spec.body("body").fullinertia[:] = tensor_of(numbers)[
        [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    ]
    return spec


def _timestep(ts: np.ndarray, omegas: np.ndarray) -> tuple[float, int]:
    """A step that divides the shortest gap, and how many reach the last sample."""
    gap, spin = np.min(np.diff(ts)), np.max(np.linalg.norm(omegas, axis=1))
    step = gap / np.ceil(max(1.0, spin * gap / _LARGEST_TURN))
    return float(step), int(np.ceil((ts[-1] - ts[0]) / step * (1 - 1e-12))) + 1


def _bounds(x0: np.ndarray, omegas: np.ndarray) -> list[np.ndarray]:
    """MuJoCo's solvers want finite ones: wide."""
    spin = 3 * np.max(np.abs(omegas))
    wide = np.array([5.0, 5.0, 20.0, 20.0, 20.0, spin, spin, spin])
    return [np.minimum(-wide, x0 - wide), np.maximum(wide, x0 + wide)]


def fit_mujoco(
    ts: np.ndarray,
    omegas: np.ndarray,
    sigma: float,
    start: tuple[np.ndarray, np.ndarray],
) -> PeerFit | None:
    """`mujoco.minimize.least_squares` over RK4 rollouts; None where MuJoCo is missing.

    Arguments as `fit_scipy`. Readings between steps are compared with a cubic spline.
    """
    try:
        mujoco = importlib.import_module("mujoco")
        minimize = importlib.import_module("mujoco.minimize")
        rollout = importlib.import_module("mujoco.rollout")
    except ImportError:
        return None
    begin = time.perf_counter()
    spec = mujoco.MjSpec.from_string(_FREE_BODY)
    spec.option.timestep, steps = _timestep(ts, omegas)
    model = spec.compile()
    data = mujoco.MjData(model)
    grid = ts[0] + spec.option.timestep * np.arange(steps + 1)

    def rates(x: np.ndarray) -> np.ndarray:
        compiled = _spec_with(spec, x[:5]).compile()
        state = np.concatenate(
            [[0.0, 1.0, 0.0, 0.0, 0.0], x[5:]]
        )  # time, quaternion, rates
        states = rollout.rollout(compiled, data, state, nstep=steps)[0]
        return CubicSpline(grid, np.vstack([x[5:], states[0, :, 5:8]]))(ts)

    evaluations = 0

    def residuals(x: np.ndarray) -> np.ndarray:
        nonlocal evaluations
        evaluations += x.shape[1]
        return np.stack([((rates(c) - omegas) / sigma).ravel() for c in x.T], axis=1)

    x0 = np.concatenate([numbers_of(start[0]), start[1]])
    x, log = minimize.least_squares(
        x0,
        residuals,
        _bounds(x0, omegas),
        max_iter=200,
        verbose=minimize.Verbosity.SILENT,
    )
    x, chi_square = np.ravel(x), float(2 * log[-1].objective)
    seconds = time.perf_counter() - begin
    return PeerFit(tensor_of(x[:5]), x[5:], chi_square, seconds, evaluations)


def fit_sysid(
    ts: np.ndarray,
    omegas: np.ndarray,
    sigma: float,
    start: tuple[np.ndarray, np.ndarray],
) -> PeerFit | None:
    """MuJoCo's toolbox: parameters with modifiers, a sequence, its optimizer.

    Arguments as `fit_scipy`. First rates are unknowns by way of `custom_rollout`, and
    the residual is over the noise by way of `modify_residual`. None where
    `mujoco[sysid]` is missing.
    """
    try:
        mujoco = importlib.import_module("mujoco")
        sysid = importlib.import_module("mujoco.sysid")
        optimize = sysid.optimize
    except (
        ImportError,
        AttributeError,
    ):  # without its extra the module is there, and empty
        return None
    begin = time.perf_counter()
    spec = mujoco.MjSpec.from_string(_FREE_BODY)
    spec.option.timestep, steps = _timestep(ts, omegas)
    model = spec.compile()
    x0 = np.concatenate([numbers_of(start[0]), start[1]])
    lower, upper = _bounds(x0, omegas)
    unknowns = sysid.ParameterDict()
    unknowns.add(
        sysid.Parameter(
            "inertia",
            x0[:5],
            lower[:5],
            upper[:5],
            modifier=lambda s, p: _spec_with(s, p.value),
        )
    )
    unknowns.add(sysid.Parameter("omega0", x0[5:], lower[5:], upper[5:]))
    grid = ts[0] + spec.option.timestep * np.arange(steps + 1)
    first = sysid.create_initial_state(model, np.array([1.0, 0.0, 0.0, 0.0]), start[1])
    control = sysid.TimeSeries(grid, np.zeros((steps + 1, 0)))
    names = {"gyro": (sysid.SignalType.MjSensor, np.arange(3))}
    measured = sysid.TimeSeries(ts, omegas, names)
    sequence = sysid.ModelSequences("body", spec, "record", first, control, measured)

    def rolled(**arguments: Any) -> Any:
        states = [x.copy() for x in arguments["initial_states"]]
        for state, one in zip(states, arguments.pop("param_dicts"), strict=True):
            state[5:8] = one["omega0"].value
        return sysid.sysid_rollout(**arguments | {"initial_states": states})

    def residuals(
        one: Any,
        _predicted: Any,
        readings: Any,
        _model: Any,
        _all: bool,
        state: np.ndarray,
    ) -> Any:
        rates = CubicSpline(grid, np.vstack([one["omega0"].value, state[:, 5:8]]))(ts)
        predicted = sysid.TimeSeries(ts, rates, names)
        return (rates - readings.data) / sigma, predicted, readings

    function = sysid.build_residual_fn(
        models_sequences=[sequence],
        custom_rollout=rolled,
        modify_residual=residuals,
        n_threads=1,
        resample_true=False,
    )
    evaluations = 0

    def counted(x: np.ndarray, parameters: Any) -> Any:
        nonlocal evaluations
        evaluations += 1 if x.ndim == 1 else x.shape[1]
        return function(x, parameters)

    # Its optimizer prints each iteration and cannot be asked not to.
    with contextlib.redirect_stdout(io.StringIO()):
        x = np.ravel(optimize(unknowns, counted, verbose=False, max_iters=200)[1].x)
    final = np.concatenate([np.ravel(r) for r in function(x, unknowns)[0]])
    seconds = time.perf_counter() - begin
    return PeerFit(tensor_of(x[:5]), x[5:], float(final @ final), seconds, evaluations)


def _record(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Tensor, times, true rates and noise of 200 samples over 10 turns."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    moments = np.array([1.0, 1.7, 2.3]) / 5 * 3
    tensor, direction = axes @ np.diag(moments) @ axes.T, rng.normal(size=3)
    ts = np.arange(200) * np.pi / 10
    unknowns = np.concatenate(
        [numbers_of(tensor), direction / np.linalg.norm(direction)]
    )
    return tensor, ts, _motions(ts, unknowns[None])[0], rng.normal(size=(200, 3))


def _starts(tensor: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Of the tensor: off by 1 and 20 % of its mean moment, and a sphere."""
    off = rng.normal(size=(3, 3))
    off = (off + off.T) / np.linalg.norm(off + off.T)
    starts = {
        "1 % off": tensor + 0.01 * off,
        "20 % off": tensor + 0.2 * off,
        "sphere": np.eye(3),
    }
    for name, one in starts.items():  # none that no body has
        moments, axes = np.linalg.eigh(one)
        moments[2] = min(moments[2], 0.98 * (moments[0] + moments[1]))
        starts[name] = axes @ np.diag(moments) @ axes.T
    return starts


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--records", type=int, default=10)
    records = parser.parse_args().records
    sigma = 0.01
    for fit in (fit_scipy, fit_mujoco, fit_sysid):
        for name in ("1 % off", "20 % off", "sphere"):
            fits = []
            for seed in range(records):
                tensor, ts, omegas, noise = _record(seed)
                start = _starts(tensor, np.random.default_rng(seed))[name]
                readings = omegas + sigma * noise
                found = fit(ts, readings, sigma, (start, readings[0]))
                if found is None:
                    break
                error = np.linalg.norm(found.tensor - tensor)
                good = found.chi_square < 600 + 5 * np.sqrt(1200)
                fits.append((good, error, found.seconds, found.evaluations))
            if not fits:
                print(f"{fit.__name__}: missing")
                break
            good, error, seconds, evaluations = np.array(fits).T
            found = f"{int(good.sum())} of {records}, error {np.median(error):.2g}"
            print(
                f"{fit.__name__:10} {name:9} {found}, {np.median(seconds):.2g} s "
                f"(longest {np.max(seconds):.2g}), {int(np.median(evaluations))} "
                "motions",
                flush=True,
            )


if __name__ == "__main__":
    main()
