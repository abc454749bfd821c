"""Inertia of 10^6 points and of a mesh of 10^5 faces, against numpy and trimesh.

    python benchmarks/bench_mass.py [--write] [--points N] [--around N]

Compile time, value and gradient apart; minimum and median of repeats, the peers in the
same run and interleaved with ours; beside each time the relative error, against sums in
extended precision. `--write` stores the table in benchmarks/results/mass.md.
"""

from typing import Any

import common
import jax
import jax.numpy as jnp
import numpy as np

import jrigid as jr

jax.config.update("jax_enable_x64", True)
REPEATS = 25


def inertia_of(second: np.ndarray) -> np.ndarray:
    return np.trace(second) * np.eye(3, dtype=second.dtype) - second


def torus(around: int, across: int) -> tuple[np.ndarray, np.ndarray]:
    """A closed mesh of 2 x around x across faces: a tilted torus off the origin."""
    i, j = (
        x.ravel()
        for x in np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    )
    u, v = 2 * np.pi * i / around, 2 * np.pi * j / across
    ring = 1 + (0.4 + 0.1 * np.cos(3 * u)) * np.cos(v)
    vertices = np.stack([ring * np.cos(u), 0.8 * ring * np.sin(u), 0.5 * np.sin(v)], 1)
    vertices[:, 2] += 0.3 * vertices[:, 0]
    here, right = i * across + j, (i + 1) % around * across + j
    up, both = (
        i * across + (j + 1) % across,
        (i + 1) % around * across + (j + 1) % across,
    )
    faces = np.concatenate(
        [np.stack([here, right, both], 1), np.stack([here, both, up], 1)]
    )
    return vertices + np.array([0.3, -0.2, 0.1]), faces


def points_numpy(masses: np.ndarray, positions: np.ndarray) -> np.ndarray:
    return inertia_of((masses[:, None] * positions).T @ positions)


def points_gradient_numpy(
    masses: np.ndarray, positions: np.ndarray, weight: np.ndarray
) -> Any:
    core = np.trace(weight) * np.eye(3, dtype=weight.dtype) - weight
    turned = positions @ core
    return np.sum(turned * positions, axis=1), 2 * masses[:, None] * turned


def mesh_numpy(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    origin = vertices.mean(axis=0)
    a, b, c = (vertices[faces[:, k]] - origin for k in range(3))
    six = np.einsum("ij,ij->i", a, np.cross(b, c))
    s = a + b + c
    second = sum((six[:, None] * x).T @ x for x in (a, b, c, s)) / 120
    volume = six.sum() / 6
    centre = six @ s / 24 / volume
    return inertia_of(second - volume * np.outer(centre, centre))


def mesh_exact(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return mesh_numpy(vertices.astype(np.longdouble), faces).astype(float)


def error(answer: Any, exact: np.ndarray) -> float:
    difference = np.asarray(answer, np.longdouble) - exact
    return float(np.max(np.abs(difference)) / np.max(np.abs(exact)))


def bench_points(count: int, dtype: Any) -> list[tuple]:
    rng = np.random.default_rng(0)
    masses = rng.uniform(0.5, 1.5, count).astype(dtype)
    positions = rng.normal(size=(count, 3)).astype(dtype)
    weight = np.arange(9.0, dtype=dtype).reshape(3, 3)
    m, r = jnp.asarray(masses), jnp.asarray(positions)
    value, compile_value = common.compiled(jr.inertia_tensor, m, r)
    gradient, compile_gradient = common.compiled(
        jax.grad(
            lambda m, r: jnp.sum(jnp.asarray(weight) * jr.inertia_tensor(m, r)), (0, 1)
        ),
        m,
        r,
    )
    body, compile_body = common.compiled(jr.from_points, m, r)
    values = common.timed(
        {
            "jrigid.inertia_tensor": lambda: value(m, r),
            "jrigid.from_points": lambda: body(m, r).inertia,
            "numpy (m r)^T r": lambda: points_numpy(masses, positions),
        }
    )
    gradients = common.timed(
        {
            "jrigid.inertia_tensor": lambda: gradient(m, r),
            "numpy by hand": lambda: points_gradient_numpy(masses, positions, weight),
        }
    )
    long_m, long_r = masses.astype(np.longdouble), positions.astype(np.longdouble)
    exact = points_numpy(long_m, long_r)
    centre = long_m @ long_r / long_m.sum()
    exact_body = points_numpy(long_m, long_r - centre)
    symmetric = (weight + weight.T) / 2
    exact_gradient = points_gradient_numpy(long_m, long_r, symmetric)[1]
    what = f"{count} points, {np.dtype(dtype).name}"
    compile_times = {
        "jrigid.inertia_tensor": compile_value,
        "jrigid.from_points": compile_body,
    }
    rows = [
        (
            what,
            "value",
            name,
            compile_times.get(name),
            low,
            mid,
            error(answer, exact_body if "from" in name else exact),
        )
        for name, (low, mid, answer) in values.items()
    ]
    hand = points_gradient_numpy(masses, positions, symmetric.astype(dtype))[1]
    rows += [
        (
            what,
            "gradient",
            name,
            compile_gradient if "jrigid" in name else None,
            low,
            mid,
            error(answer[1] if "jrigid" in name else hand, exact_gradient),
        )
        for name, (low, mid, answer) in gradients.items()
    ]
    return rows


def bench_mesh(around: int) -> list[tuple]:
    import trimesh

    vertices, faces = torus(around, 200)
    v = jnp.asarray(vertices)
    weight = jnp.arange(9.0).reshape(3, 3)

    def body(v: Any) -> Any:
        return jr.from_mesh(v, faces).inertia

    value, compile_value = common.compiled(body, v)
    gradient, compile_gradient = common.compiled(
        jax.grad(lambda v: jnp.sum(weight * body(v))), v
    )
    values = common.timed(
        {
            "jrigid.from_mesh, jit": lambda: value(v),
            "jrigid.from_mesh, eager with its checks": lambda: body(v),
            "numpy": lambda: mesh_numpy(vertices, faces),
            "trimesh.triangles.mass_properties": lambda: (
                trimesh.triangles.mass_properties(vertices[faces])["inertia"]
            ),
            "trimesh.Trimesh(...).moment_inertia": lambda: (
                trimesh.Trimesh(vertices, faces, process=False).moment_inertia
            ),
        }
    )
    gradients = common.timed({"jrigid.from_mesh, jit": lambda: gradient(v)})
    exact = mesh_exact(vertices, faces)
    what = f"mesh of {len(faces)} faces, float64"
    rows = [
        (
            what,
            "value",
            name,
            compile_value if "jit" in name else None,
            low,
            mid,
            error(answer, exact),
        )
        for name, (low, mid, answer) in values.items()
    ]
    low, mid, answer = gradients["jrigid.from_mesh, jit"]
    # Along a dilation about the origin of a body about its centre, dI = 5 I: an exact
    # check.
    along = float(np.sum(np.asarray(answer) * vertices))
    wanted = float(5 * np.sum(np.asarray(weight) * exact))
    rows.append(
        (
            what,
            "gradient",
            "jrigid.from_mesh, jit",
            compile_gradient,
            low,
            mid,
            abs(along - wanted) / np.sum(np.abs(np.asarray(answer) * vertices)),
        )
    )
    return rows


HEADER = (
    "problem",
    "what",
    "who",
    "compile ms",
    "min ms",
    "median ms",
    "relative error",
)


def main() -> None:
    parser = common.arguments(__doc__)
    parser.add_argument("--points", type=int, default=10**6)
    parser.add_argument("--around", type=int, default=250)
    options = parser.parse_args()
    rows = bench_points(options.points, np.float64) + bench_points(
        options.points, np.float32
    )
    rows += bench_mesh(options.around)
    text = common.table(HEADER, rows)
    common.report(
        "mass", "Mass properties", text, ("jax", "numpy", "trimesh"), options.write
    )


if __name__ == "__main__":
    main()
