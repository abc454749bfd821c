"""How far `find_spin` is off, in units of the errors that it states.

    python benchmarks/bench_spins.py [--write] [--bodies 12]

Each body is the convex hull of a dented ellipsoid, which no harmonics of low degree
describe exactly, on an orbit of its own. It is seen in 12 nights of 28 points over
three apparitions, with a noise of 0.01 mag in relative curves. Their light is computed
by plain numpy. The range that is searched holds five trial periods about the true one.
Of the solutions that are listed, the one whose pole is nearest to the true one counts.
"""

import resource

import common
import jax
import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from jrigid import photometry as ph

DAY, HOUR, AU = 86400.0, 3600.0, 149597870700.0
EPOCH = 2455000.5
NIGHTS = (-45.0, -12.0, 8.0, 40.0)  # days from an opposition
POINTS = 28
NOISE = 0.01  # mag
LAMBERT = 0.1


def body(rng):
    """Areas and normals of the hull of an ellipsoid with eight dents and bumps."""
    index = np.arange(1500) + 0.5
    height = 1 - 2 * index / 1500
    longitude = np.pi * (1 + 5**0.5) * index
    across = np.sqrt(1 - height**2)
    sphere = np.stack(
        [across * np.cos(longitude), across * np.sin(longitude), height], axis=1
    )
    middle = rng.uniform(0.6, 0.9)
    axes = np.array([1.0, middle, middle * rng.uniform(0.75, 1.0)])
    size = np.ones(1500)
    for _ in range(8):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        power = rng.integers(1, 4)
        size += 0.08 * rng.normal() * (sphere @ direction) ** power
    corners = sphere * axes * size[:, None]
    triangles = corners[ConvexHull(corners).simplices]
    sides = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    normals = np.cross(*sides)
    outward = np.einsum("ni,ni->n", normals, triangles.mean(axis=1) - corners.mean(0))
    normals *= np.sign(outward)[:, None]
    doubled = np.linalg.norm(normals, axis=1)
    return doubled / 2, normals / doubled[:, None]


def unit(vectors):
    """Vectors of length 1."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def oppositions(positions):
    """Days of the first three oppositions."""
    days = EPOCH + np.arange(2200.0)
    sun, earth = positions(days)
    angle = np.arccos(np.sum(unit(sun) * unit(earth), axis=1))
    least = (angle[1:-1] < angle[:-2]) & (angle[1:-1] <= angle[2:])
    near = np.linalg.norm(earth, axis=1) < np.linalg.norm(sun, axis=1)
    return days[1:-1][least & near[1:-1]][:3]


def observed(seed):
    """Light curves of a body, its pole [rad] and its period [s]."""
    rng = np.random.default_rng(seed)
    areas, normals = body(rng)
    longitude = rng.uniform(0, 2 * np.pi)
    latitude = np.arcsin(rng.uniform(-1, 1))
    period = rng.uniform(5, 9) * HOUR
    node, perihelion, anomaly = rng.uniform(0, 2 * np.pi, 3)
    orbit = ph.Orbit(
        rng.uniform(2.2, 3.0) * AU,
        rng.uniform(0.05, 0.25),
        np.deg2rad(rng.uniform(3, 20)),
        node,
        perihelion,
        anomaly,
        EPOCH,
    )
    positions = ph.geometry_of_orbit(orbit)
    tilt = Rotation.from_euler("ZY", [longitude, np.pi / 2 - latitude])
    curves = []
    for day in oppositions(positions):
        for night in NIGHTS:
            start = day + night + rng.uniform(-0.2, 0.2)
            dates = start + np.sort(rng.uniform(0, 0.25, POINTS))
            sun, earth = positions(dates)
            # 299792458 m/s is the speed of light.
            ts = (dates - EPOCH) * DAY - np.linalg.norm(earth, axis=1) / 299792458.0
            spins = np.multiply.outer(2 * np.pi * ts / period, [0.0, 0.0, 1.0])
            turn = tilt * Rotation.from_rotvec(spins)
            lit, seen = (
                np.maximum(turn.inv().apply(unit(x)) @ normals.T, 0)
                for x in (sun, earth)
            )
            both = (lit > 0) & (seen > 0)
            law = 1 / np.where(both, lit + seen, 1.0) + LAMBERT
            light = np.where(both, lit * seen * law, 0.0) @ areas
            light *= 10 ** (-0.4 * NOISE * rng.normal(size=POINTS))
            light /= light.mean()
            curves.append(ph.LightCurve(EPOCH, ts, light, sun, earth, True))
    return curves, (longitude, latitude), period


def between(angle):
    """An angle from -pi to pi."""
    return np.mod(angle + np.pi, 2 * np.pi) - np.pi


def result_of(seed):
    """A row of the table, and deviations over errors."""
    curves, (longitude, latitude), period = observed(seed)
    span = curves[-1].ts.max() - curves[0].ts.min()
    width = period**2 / span
    before = resource.getrusage(resource.RUSAGE_SELF).ru_utime
    found = ph.find_spin(curves, NOISE, shortest=period - width, longest=period + width)
    seconds = resource.getrusage(resource.RUSAGE_SELF).ru_utime - before

    def angle(spin):
        east = between(spin.estimates.longitude - longitude) * np.cos(latitude)
        return np.rad2deg(np.hypot(east, spin.estimates.latitude - latitude))

    nearest = min(found.solutions, key=angle)
    estimates, errors = nearest.estimates, nearest.errors
    deviations = (
        float(between(estimates.longitude - longitude) / errors.longitude),
        float((estimates.latitude - latitude) / errors.latitude),
        float((estimates.period - period) / errors.period),
    )
    row = (
        str(seed),
        str(len(found.solutions)),
        f"{angle(found.solutions[0]):.1f}",
        f"{angle(nearest):.1f}",
        *(f"{x:.1f}" for x in deviations),
        "yes" if found.follows else "no",
        f"{seconds:.0f}",
    )
    return row, deviations


def main():
    jax.config.update("jax_enable_x64", True)
    parser = common.arguments(__doc__)
    parser.add_argument("--bodies", type=int, default=12)
    options = parser.parse_args()
    rows, deviations = zip(*map(result_of, range(options.bodies)), strict=True)
    together = np.sqrt(np.mean(np.square(deviations), axis=0))
    middle = np.median(np.abs(deviations), axis=0)
    text = common.table(
        (
            "body",
            "solutions",
            "first off [deg]",
            "nearest off [deg]",
            "longitude",
            "latitude",
            "period",
            "follows",
            "CPU s",
        ),
        rows,
    )
    text += (
        "\n\nDeviations over stated errors, of the solution nearest to the truth, in "
        "longitude, latitude and period: root mean square "
        + ", ".join(f"{x:.1f}" for x in together)
        + "; median of the sizes "
        + ", ".join(f"{x:.1f}" for x in middle)
        + ".\n"
    )
    common.report(
        "spins",
        "Deviations of poles and periods over their stated errors",
        text,
        ("jax", "numpy"),
        options.write,
    )


if __name__ == "__main__":
    main()
