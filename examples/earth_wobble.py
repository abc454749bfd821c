"""What the Earth's wobble says about its inertia.

The Earth does not spin about its axis of figure. The pole of rotation moves on the
ground in loops of about ten metres. A rigid Earth without torques would wobble once in
305 days. Here the Earth is a rotating body that obeys Euler's equations under seasonal
torques. Gradients through the integration fit the record of its pole since 1962, and
give (I3 - I1)/I1.

Run it: `python earth_wobble.py [picture.png]`.
"""

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from scipy.optimize import minimize_scalar

import jrigid as jr

MAS = math.pi / 648e6  # one milliarcsecond [rad]; 3.1 cm on the ground at the pole
SPIN_PER_DAY = (
    7.292115e-5 * 86400.0
)  # sidereal radians in a day (IERS Conventions 2010, table 1.1)
TURNS_PER_DAY = SPIN_PER_DAY / (2 * math.pi)
ANNUAL = 2 * math.pi / 365.2422 / SPIN_PER_DAY  # annual frequency per sidereal radian
SEASONS = (
    np.array([1.0, -1.0, 2.0, -2.0]) * ANNUAL
)  # annual and semiannual, with and against spin
RIGID_PERIOD = 305.0  # days: Euler's period of a rigid body with the Earth's moments
SCALE = 100 * MAS  # size of the wobble: makes residuals and parameters of order one
DAYS_PER_SAMPLE = 10
PICTURE = Path(__file__).parents[1] / "outputs" / "earth_wobble.png"


class Wobble(eqx.Module):
    """Parameters of the Earth's motion, all of order one.

    A pair of real numbers is a complex number: x toward Greenwich plus i times y toward
    90 deg east.

    Attributes:
        ellipticity: (I3 - I1)/I1, in units of that of a rigid Earth, 1/305 sidereal
            turns.
        start: Direction of the spin at the start of the record, from the axis of figure
            [SCALE].
        seasons: Torques at the four frequencies SEASONS [SCALE * ANNUAL * I1 *
            Omega^2].
        drift: Drift of the axis of figure, as Legendre coefficients of degree 0 to 3
            [SCALE].
    """

    ellipticity: Float[Array, ""]
    start: Float[Array, " 2"]
    seasons: Float[Array, "4 2"]
    drift: Float[Array, "4 2"]


def ellipticity_of_period(days: Any) -> Any:
    """(I3 - I1)/I1 of a body whose wobble takes this many (mean solar) days."""
    return 1.0 / (days * TURNS_PER_DAY)


class Pole(eqx.Module):
    """The pole of rotation, averaged over DAYS_PER_SAMPLE days.

    Attributes:
        mjd: Modified Julian Date of the middle of each average.
        m: Complex direction of the spin in the terrestrial frame [SCALE].
    """

    mjd: Float[np.ndarray, " times"]
    m: Complex[np.ndarray, " times"]

    @property
    def tau(self) -> np.ndarray:
        """Time since the first sample [sidereal radians]."""
        return (self.mjd - self.mjd[0]) * SPIN_PER_DAY

    @property
    def years(self) -> np.ndarray:
        """Calendar years."""
        return 2000.0 + (self.mjd - 51544.5) / 365.25


def rotation_pole(record: jr.datasets.EarthPole, days: int = DAYS_PER_SAMPLE) -> Pole:
    """The pole of rotation, computed from the published pole.

    The published pole p = x - i y is the celestial intermediate pole, and y is positive
    toward the west. The pole of rotation is m = p - (i / Omega) dp/dt (Gross,
    J. Geophys. Res. 97, 6979 (1992)). For the wobble the two differ by 0.2 %.
    """
    p = (record.x - 1j * record.y) / SCALE
    m = p - 1j / SPIN_PER_DAY * np.gradient(p, record.mjd)
    samples = len(m) // days

    def average(series):
        return series[: samples * days].reshape(samples, days).mean(axis=1)

    return Pole(average(record.mjd), average(m))


def drift_basis(tau: Float[np.ndarray, " times"]) -> Float[np.ndarray, "times 4"]:
    """Legendre polynomials of degree 0 to 3 over the record."""
    return np.polynomial.legendre.legvander(2 * tau / tau[-1] - 1, 3)


def seasonal_torque(seasons: Float[Array, "4 2"], tau: Any) -> Float[Array, " 3"]:
    """Seasonal torque (real + i imaginary) exp(i season tau) [I1 Omega^2]."""
    real, imaginary = seasons.T * (SCALE * ANNUAL)
    of_cosine = jnp.stack([real, imaginary, jnp.zeros(4)])
    of_sine = jnp.stack([-imaginary, real, jnp.zeros(4)])
    return of_cosine @ jnp.cos(SEASONS * tau) + of_sine @ jnp.sin(SEASONS * tau)


class Ground(jr.torques.AbstractTorque):
    """The seasonal torque, and the drift of the axis of figure on the ground.

    Attributes:
        seasons: As in `Wobble`.
        drift: As in `Wobble`.
        span: Length of the record [sidereal radians].
    """

    seasons: Float[Array, "4 2"]
    drift: Float[Array, "4 2"]
    span: float = eqx.field(static=True)

    def __call__(self, t: Any, state: Any, args: Any) -> Array:
        """Torque at the time tau [I1 Omega^2]."""
        del state, args
        return seasonal_torque(self.seasons, t)


def moments_of(ellipticity: Any) -> Float[Array, " 3"]:
    """The moments of inertia in units of I1."""
    return jnp.array([1.0, 1.0, 1.0]).at[2].add(ellipticity)


def motion(system: Any, state: jr.State, tau: Array, start: Any) -> jr.State:
    """Euler's equations, integrated from sample to sample.

    In units of Omega and of I1 the moments are (1, 1, 1 + e), the spin is (m1, m2, 1)
    and tau is the angle that the Earth has turned. One wobble takes 1/e turns of the
    Earth, so a step can span many turns. Only omega is integrated, and fixed steps keep
    its derivatives right.
    """
    del start  # the first sample

    def rate(tau, omega, _):
        return jr.euler_equations(system.inertia, omega, system.torque(tau, None, None))

    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(rate),
        diffrax.Tsit5(),
        tau[0],
        tau[-1],
        None,
        state.omega,
        stepsize_controller=diffrax.StepTo(tau),
        saveat=diffrax.SaveAt(t0=True, steps=True),
        adjoint=diffrax.ForwardMode(),
        max_steps=len(tau) - 1,
    )
    omega = cast(Array, solution.ys)
    return jr.State(jnp.broadcast_to(state.attitude, (len(tau), 4)), omega)


def start_of(wobble: Wobble) -> jr.State:
    """The spin at the beginning of the record. The attitude has no effect."""
    return jr.State(jnp.array([1.0, 0, 0, 0]), jnp.append(wobble.start * SCALE, 1.0))


def pole_of_body(
    wobble: Wobble, tau: Float[Array, " times"]
) -> Float[Array, "times 2"]:
    """Direction of the spin from the axis of figure [SCALE]."""
    inertia = moments_of(wobble.ellipticity * ellipticity_of_period(RIGID_PERIOD))
    body = jr.RigidBody(inertia, Ground(wobble.seasons, wobble.drift, 1.0))
    return motion(body, start_of(wobble), tau, tau[0]).omega[:, :2] / SCALE


def seen(tau: Any, state: jr.State, system: Any) -> Float[Array, " 3"]:
    """Observed values: the pole from the ground [SCALE], and the spin [Omega]."""
    x = 2 * tau / system.torque.span - 1
    legendre = jnp.stack(
        [jnp.ones_like(x), x, 1.5 * x * x - 0.5, (2.5 * x * x - 1.5) * x]
    )
    pole = state.omega[:2] / SCALE + legendre @ system.torque.drift
    return jnp.concatenate([pole, state.omega[2:]])


class WobbleFit(eqx.Module):
    """Result of a fit of the pole.

    Attributes:
        params: Best parameters.
        residuals: Modelled minus observed, x and y of each time [SCALE].
        jacobian: Their derivatives in the ellipticity and the other parameters, in any
            order.
        steps: Evaluations of the integration and its derivatives.
        converged: Whether the fit met its tolerance.
    """

    params: Wobble
    residuals: Float[Array, " rows"]
    jacobian: Float[Array, "rows params"]
    steps: int
    converged: bool


def fit_wobble(pole: Pole, period: float = RIGID_PERIOD) -> WobbleFit:
    """Fit the Earth's motion by gradients. Only the sign of the wobble is given.

    The noise of the pole is that of its residuals. The spin is known from clocks, with
    almost no noise, and one value of it is enough.

    Args:
        pole: The observed pole.
        period: Initial value of the wobble period [days], by default of a rigid Earth.

    Returns:
        The fit.
    """
    span = float(pole.tau[-1])
    spin = np.where(pole.tau == 0, 1.0, np.nan)
    values = np.stack([np.real(pole.m), np.imag(pole.m), spin], axis=1)
    guess = Wobble(
        ellipticity=jnp.asarray(RIGID_PERIOD / period),
        start=jnp.asarray(values[0, :2]),
        seasons=jnp.zeros((4, 2)),
        drift=jnp.zeros((4, 2)),
    )
    unit = ellipticity_of_period(RIGID_PERIOD)
    body = jr.RigidBody(
        moments_of(guess.ellipticity * unit), Ground(guess.seasons, guess.drift, span)
    )
    found = jr.identify.fit(
        body,
        jr.identify.Observed(seen, pole.tau, values, np.array([1.0, 1.0, 1e-9])),
        inertia_model=jr.identify.Top(),
        free=lambda body: (body.torque.seasons, body.torque.drift),
        start=start_of(guess),
        motion=motion,
        doublings=5,  # begin with two years of the record
        absolute_sigma=False,
        throw=False,
    )
    moments = jnp.diagonal(found.inertia)
    ellipticity = moments[2] / moments[0] - 1
    ground: Any = found.system.torque
    params = Wobble(
        ellipticity / unit,
        found.state.omega[0, :2] / SCALE,
        ground.seasons,
        ground.drift,
    )
    # The unknown is log((1 - e) / (1 + e)). The spin and the attitude are not reported.
    of_ellipticity = -2 * unit / (1 - ellipticity**2)
    columns = found.numbers.size + 2
    jacobian = found.diagnostics.jacobian[0]
    jacobian = jacobian.reshape(-1, 3, jacobian.shape[-1])[:, :2, :columns]
    jacobian = jacobian.at[..., 0].multiply(of_ellipticity).reshape(-1, columns)
    rows = found.diagnostics.residuals[0].reshape(-1, 3)[:, :2].reshape(-1)
    steps = int(np.sum(np.isfinite(found.diagnostics.history)))
    # The residuals contain the excitation of the wobble, which is not white, so the
    # status is MISFIT. `kicked_covariance` accounts for it.
    status = jr.identify.Status
    converged = bool((found.status == status.OK) | (found.status == status.MISFIT))
    return WobbleFit(params, rows, jacobian, steps, converged)


def period_of_fit(fit: WobbleFit) -> float:
    """Wobble period of a fit [days]."""
    return RIGID_PERIOD / float(fit.params.ellipticity)


def linear_misfit(pole: Pole) -> Callable[[Any], Any]:
    """Misfit of the same model as a function of the rate, by linear least squares.

    The small wobble of a symmetric body is an exponential, and its response to seasonal
    torques four others. At a given rate everything else is linear. Parts that do not
    depend on the rate are projected out.

    Returns:
        A function from (I3 - I1)/I1, of either sign, one or many, to the residuals'
        root mean square [mas].
    """
    tau = pole.tau
    others = np.concatenate(
        [np.exp(1j * np.outer(tau, SEASONS)), drift_basis(tau)], axis=1
    )
    others = np.linalg.qr(others)[0]

    rest = pole.m - others @ (others.conj().T @ pole.m)

    def misfit(ellipticity):
        wobble = np.exp(1j * np.multiply.outer(ellipticity, tau))
        norm = len(tau) - np.sum(np.abs(wobble.conj() @ others) ** 2, axis=-1)
        norm = np.maximum(norm, 1e-9 * len(tau))  # slow ones are drift
        explained = np.abs(wobble.conj() @ rest) ** 2 / norm
        return np.sqrt((np.vdot(rest, rest).real - explained) / len(tau)) * SCALE / MAS

    return misfit


def linear_fit(pole: Pole) -> float:
    """Wobble period [days] by linear least squares, scanned above 200 days.

    The period is negative for a wobble against the spin, which a prolate body has.
    """
    misfit = linear_misfit(pole)
    step = 0.1 * 2 * math.pi / pole.tau[-1]
    fastest = ellipticity_of_period(200.0)
    scan = np.arange(-fastest, fastest, step)
    near = scan[np.argmin(misfit(scan))]
    best = minimize_scalar(
        misfit,
        bounds=(near - step, near + step),
        method="bounded",
        options={"xatol": 1e-7 * step},
    )
    return float(1.0 / (best.x * TURNS_PER_DAY))


def kick_level(
    pole: Pole, residual: Complex[np.ndarray, " times"], period: float
) -> float:
    """Power density of the excitation near the frequency of the wobble.

    Air and water excite the Earth all the time, and it keeps wobbling after each kick.
    The residuals of the fit are the sum of all kicks, each rotating with the wobble.
    Undoing this rotation from sample to sample leaves the kicks themselves. Their
    spectrum is evaluated from -0.3 to 0.1 cycles a year off the wobble. The kicks
    dominate there, and the annual line is outside.

    Returns:
        Variance of the (complex) kicks in a sidereal radian [SCALE^2].
    """
    step = pole.tau[1] - pole.tau[0]
    turning = np.exp(1j * ellipticity_of_period(period) * pole.tau)
    kicks = np.diff(residual / turning)
    power = np.abs(np.fft.fft(kicks)) ** 2 / (len(kicks) * step)
    cycles_per_year = np.fft.fftfreq(len(kicks), step / SPIN_PER_DAY / 365.25)
    near = (cycles_per_year > -0.3) & (cycles_per_year < 0.1)
    return float(power[near].mean())


def kicked_covariance(pole: Pole, fit: WobbleFit) -> Float[Array, "params params"]:
    """Covariance of the parameters of `fit` if random kicks excite the wobble."""
    x, y = np.asarray(fit.residuals).reshape(-1, 2).T
    period = period_of_fit(fit)
    variance = kick_level(pole, x + 1j * y, period) * (pole.tau[1] - pole.tau[0])
    turning = np.exp(1j * ellipticity_of_period(period) * pole.tau)
    return _kicked_covariance(fit.jacobian, jnp.asarray(turning), jnp.asarray(variance))


@jax.jit
def _kicked_covariance(jacobian, turning, variance):
    def colour(rows):  # each kick appears, rotated, in every later row
        rows = jax.lax.complex(*rows.reshape(-1, 2).T) / turning
        kicks = jnp.cumsum(rows[::-1])[::-1] * turning
        return jnp.concatenate([kicks.real, kicks.imag]) * jnp.sqrt(variance / 2)

    return jr.identify.coloured_covariance(jacobian, colour)


class Result(eqx.Module):
    """Result of the study.

    Attributes:
        pole: The observed pole.
        modelled: The fitted pole [SCALE].
        period: Wobble period [days].
        period_error: Its standard error, for a wobble that is excited all the time
            [days].
        bootstrap_error: Its error by a bootstrap over blocks of four years [days].
        ellipticity: Effective (I3 - I1)/I1.
        ellipticity_error: Its standard error.
        rms: Root mean square of the residuals [mas].
        rigid_rms: The same for the best motion with a period of 305 days [mas].
        linear_period: Period by linear least squares [days].
        windows: Period by linear least squares in parts of the record: (from, to,
            days).
        drift: Fitted drift of the axis of figure, Legendre coefficients of x and y
            [SCALE].
        steps: Evaluations of the integration and its derivatives.
    """

    pole: Pole
    modelled: Complex[np.ndarray, " times"]
    period: float
    period_error: float
    bootstrap_error: float
    ellipticity: float
    ellipticity_error: float
    rms: float
    rigid_rms: float
    linear_period: float
    windows: tuple[tuple[int, int, float], ...]
    drift: Float[np.ndarray, "4 2"]
    steps: int


def analyse(pole: Pole) -> Result:
    """Fit the pole and estimate the errors of the fit."""
    fit = fit_wobble(pole)
    if not bool(fit.converged):
        raise RuntimeError("The fit of the Earth's wobble did not converge.")
    period = period_of_fit(fit)
    residual = fit.residuals.reshape(-1, 2)
    x, y = np.asarray(residual).T
    relative_error = (
        math.sqrt(kicked_covariance(pole, fit)[0, 0]) * period / RIGID_PERIOD
    )
    shifts = jr.identify.block_bootstrap(
        fit.jacobian.reshape(*residual.shape, -1),
        residual,
        round(4 * 365.25 / DAYS_PER_SAMPLE),
        jax.random.key(1891),  # the year of Chandler's discovery
    )
    last = int(pole.years[-1])
    windows = []
    for begin, end in ((1962, 1985), (1985, 2005), (2000, 2010), (2005, last + 1)):
        inside = (pole.years >= begin) & (pole.years < end)
        days = linear_fit(Pole(pole.mjd[inside], pole.m[inside]))
        windows.append((begin, min(end, last), days))
    return Result(
        pole=pole,
        modelled=pole.m + (x + 1j * y),
        period=period,
        period_error=relative_error * period,
        bootstrap_error=float(jnp.std(shifts[:, 0])) * period**2 / RIGID_PERIOD,
        ellipticity=ellipticity_of_period(period),
        ellipticity_error=relative_error * ellipticity_of_period(period),
        rms=math.sqrt(np.mean(x**2 + y**2)) * SCALE / MAS,
        rigid_rms=float(linear_misfit(pole)(ellipticity_of_period(RIGID_PERIOD))),
        linear_period=linear_fit(pole),
        windows=tuple(windows),
        drift=np.asarray(fit.params.drift),
        steps=int(fit.steps),
    )


def report(result: Result) -> str:
    """The short table."""
    years = result.pole.years
    rigid = ellipticity_of_period(RIGID_PERIOD)
    error = result.period_error
    effective, effective_error = result.ellipticity, result.ellipticity_error
    off = (result.period - RIGID_PERIOD) / error
    agreement = abs(result.period - result.linear_period) / error
    windows = ", ".join(
        f"{days:.0f} d ({begin}-{end})" for begin, end, days in result.windows
    )
    return f"""\
The Earth's wobble, {years[0]:.0f} to {years[-1]:.1f}: IERS C04, {len(years)} poles, \
{result.steps} integrations with derivatives

                            start, rigid    fitted, effective
  wobble period [days]      {RIGID_PERIOD:9.1f}       {result.period:9.1f} \
+- {error:.1f}
  (I3 - I1)/I1              {rigid:9.6f}       {effective:9.6f} +- {effective_error:.6f}
  residuals, rms [mas]      {result.rigid_rms:9.1f}       {result.rms:9.1f}

  Linear least squares on the same model: {result.linear_period:.2f} days, \
{agreement:.5f} standard errors away.
  A rigid Earth's 305 days are {off:.0f} standard errors away. The solid Earth and the
  ocean yield to the wobble, which slows it; the fluid core stays out of it, which
  quickens it, but by less.
  A bootstrap over blocks of four years would claim \
+- {result.bootstrap_error:.1f} days. That is too sure: air
  and water kick the wobble all the time, and it remembers for decades. The errors above
  count the kicks; windows show them:
  {windows}.
  For the same reason no trustworthy damping comes out of this record: none is fitted.
  One mas is 3.1 cm at the pole; the residuals are the kicked wobble, not errors of
  measurement."""


def draw(result: Result, path: Path) -> None:
    """Write the picture: the path of the pole, observed and modelled."""
    import matplotlib

    matplotlib.use("Agg")
    figure = picture(result)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def picture(result: Result) -> Any:
    """The path of the pole, observed and modelled, as a matplotlib figure."""
    import matplotlib.pyplot as plt
    from matplotlib.collections import LineCollection
    from matplotlib.colors import ListedColormap, Normalize

    years = result.pole.years
    mas = SCALE / MAS
    observed, modelled = result.pole.m * mas, result.modelled * mas
    ink, faint, red = "#22303c", "#9aa7b1", "#d1495b"
    colours = ListedColormap(
        0.35 + 0.65 * plt.get_cmap("viridis")(np.linspace(0, 1, 256))
    )
    tone = Normalize(years[0], years[-1] + 6)

    def coloured(axes, x, y, when, **style):
        points = np.stack([x, y], axis=1)
        lines = list(np.stack([points[:-1], points[1:]], axis=1))
        axes.add_collection(
            LineCollection(lines, array=when[:-1], cmap=colours, norm=tone, **style)
        )

    figure = plt.figure(figsize=(13, 9.9), facecolor="white")
    grid = figure.add_gridspec(
        3,
        3,
        height_ratios=(1, 1, 2.3),
        hspace=0.3,
        wspace=0.27,
        left=0.055,
        right=0.975,
        top=0.885,
        bottom=0.065,
    )
    figure.text(
        0.055,
        0.962,
        "The path of the Earth's pole",
        fontsize=21,
        color=ink,
        weight="bold",
    )
    figure.text(
        0.055,
        0.931,
        "observed (colour) and as a rotating body moves by Euler's equations "
        f"(black); it wobbles once in {result.period:.1f} \u00b1 "
        f"{result.period_error:.1f} days, (I3 \u2212 I1)/I1 = "
        f"{result.ellipticity:.6f} \u00b1 {result.ellipticity_error:.6f}",
        fontsize=11,
        color=ink,
    )

    # The coil: time runs to the right, and the plane of the pole is tilted.
    middle = (years[0] + years[-1]) / 2
    for row, (begin, end) in enumerate(((years[0], middle), (middle, years[-1]))):
        axes = figure.add_subplot(grid[row, :])
        part = (years >= begin) & (years <= end)
        drift = np.convolve(
            np.pad(observed, 117, mode="edge"), np.ones(235) / 235, mode="valid"
        )
        for series, style in ((observed, "colour"), (modelled, "black")):
            coil = (series - drift)[part]
            x, y = years[part] + 0.0016 * coil.real, coil.imag
            if style == "colour":
                coloured(axes, x, y, years[part], linewidths=3.6, capstyle="round")
            else:
                axes.plot(x, y, color=ink, linewidth=0.75)
        axes.set_xlim(begin - 0.5, end + 0.5)
        axes.set_ylim(-330, 330)
        axes.set_yticks([-200, 0, 200])
        axes.set_ylabel("toward 90\u00b0 E [mas]", color=ink)

    axes = figure.add_subplot(grid[2, 0])
    coloured(axes, observed.imag, observed.real, years, linewidths=1.0, alpha=0.9)
    wander = drift_basis(result.pole.tau) @ result.drift * mas
    axes.plot(
        wander[:, 1], wander[:, 0], color=red, linewidth=3, solid_capstyle="round"
    )
    axes.annotate(
        "the figure's axis\nwanders",
        (wander[-1, 1], wander[-1, 0]),
        (-680, 440),
        color=red,
        fontsize=9.5,
        arrowprops={"arrowstyle": "-", "color": red, "linewidth": 0.8},
    )
    axes.set(xlim=(-700, 250), ylim=(480, -470), aspect="equal", box_aspect=1)
    axes.set_xticks([-600, -400, -200, 0, 200])
    axes.set_title(
        "All of it, seen from above the north pole", fontsize=11, color=ink, loc="left"
    )
    axes.set_xlabel("toward 90\u00b0 E [mas]   (100 mas is 3.1 m)", color=ink)
    axes.set_ylabel("toward Greenwich [mas]  (downward)", color=ink)

    axes = figure.add_subplot(grid[2, 1])
    beat = (years > 1967.5) & (years < 1974.0)
    coloured(
        axes,
        observed.imag[beat],
        observed.real[beat],
        years[beat],
        linewidths=4.5,
        capstyle="round",
    )
    axes.plot(modelled.imag[beat], modelled.real[beat], color=ink, linewidth=1.1)
    axes.set(xlim=(-550, 50), ylim=(300, -300), aspect="equal", box_aspect=1)
    axes.set_title(
        "One beat of wobble and year: 1967.5 to 1974",
        fontsize=11,
        color=ink,
        loc="left",
    )
    axes.set_xlabel("toward 90\u00b0 E [mas]", color=ink)

    axes = figure.add_subplot(grid[2, 2])
    periods = 1 / np.linspace(1 / 285, 1 / 520, 700)
    misfit = linear_misfit(result.pole)
    axes.plot(periods, misfit(ellipticity_of_period(periods)), color=ink, linewidth=1.4)
    axes.plot(RIGID_PERIOD, result.rigid_rms, "o", color=red, markersize=8)
    axes.annotate(
        "rigid Earth,\n305 days:\nthe start",
        (RIGID_PERIOD, result.rigid_rms),
        (292, 112),
        color=red,
        fontsize=10,
        arrowprops={"arrowstyle": "-", "color": red, "linewidth": 0.8},
    )
    axes.plot(result.period, result.rms, "o", color=colours(0.45), markersize=8)
    axes.annotate(
        f"{result.period:.1f} days",
        (result.period, result.rms),
        (445, 72),
        color=colours(0.45),
        fontsize=10,
    )
    axes.set(xlim=(285, 500), ylim=(60, 150), box_aspect=1)
    axes.set_title("Why a blind fit needs care", fontsize=11, color=ink, loc="left")
    axes.set_xlabel("wobble period [days]", color=ink)
    axes.set_ylabel("residuals, rms [mas]", color=ink)

    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color(faint)
        axes.tick_params(colors=ink, length=3)
    return figure


def main(path: Path) -> None:
    """Print the table and draw the picture."""
    jax.config.update("jax_enable_x64", True)
    result = analyse(rotation_pole(jr.datasets.earth_pole()))
    print(report(result))
    draw(result, path)
    print(f"\nThe path of the pole, observed and modelled: {path}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else PICTURE)
