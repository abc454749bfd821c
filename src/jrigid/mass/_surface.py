"""Whether triangles bound a body: whether they close, and how often they wind around a point."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jrigid._checks import all_finite
from jrigid.mass._validity import ULPS

# Corners looked at, over all parts, and solid angles taken there (10 ms); but one corner a part.
_SAMPLES, _ANGLES = 16, 500_000


def closed_parts(faces: np.ndarray, vertices: int) -> tuple[bool, np.ndarray | None]:
    """Whether known faces are closed and, if so and they fall in several parts, `_samples`."""
    faces = faces.astype(np.int64)
    if faces.min() < 0 or faces.max() >= vertices:
        return False, None
    a, b, c = faces.T
    start, end = np.concatenate([a, b, c]), np.concatenate([b, c, a])
    low, high = np.minimum(start, end), np.maximum(start, end)
    edges = np.sort(2 * (low * vertices + high) + (start > end))
    forth, back = edges[::2], edges[1::2]
    # Sorted, every edge once forth and once back leaves no room for a third run or a point.
    if edges.size % 2 or np.any(forth % 2) or np.any(back != forth + 1):
        return False, None
    part = _parts(*np.divmod(forth // 2, vertices), vertices)
    if np.all(part[a] == part[a[0]]):
        return True, None
    return True, _samples(faces, part)


def _parts(low: np.ndarray, high: np.ndarray, vertices: int) -> np.ndarray:
    """The least vertex that edges connect each vertex to."""
    parent = np.arange(vertices)
    while low.size:
        parent[high] = low  # of several lower neighbours any will do
        while np.any((above := parent[parent]) != parent):
            parent = above
        low, high = parent[low], parent[high]
        apart = low != high
        low, high = np.minimum(low, high)[apart], np.maximum(low, high)[apart]
    return parent


def _samples(faces: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Faces, turned so that the corner comes first, at corners spread evenly over each part."""
    place = np.full(part.size, -1)
    place[faces.ravel()] = np.arange(faces.size)
    used = np.flatnonzero(place >= 0)
    used = used[np.argsort(part[used], kind="stable")]
    starts = np.flatnonzero(np.diff(part[used], prepend=-1))
    sizes = np.diff(starts, append=used.size)
    count = max(1, min(_SAMPLES, _ANGLES // len(faces)) // starts.size)
    picks = starts[:, None] + np.arange(count)[None, :] * sizes[:, None] // count
    face, corner = np.divmod(place[used[picks.ravel()]], 3)
    turned = (corner[:, None] + np.arange(3)[None, :]) % 3
    return faces[face[:, None], turned].astype(np.int32)


def closed_traced(faces: Int[Array, "faces 3"], vertices: int) -> Bool[Array, ""]:
    if faces.shape[0] % 2:
        return jnp.asarray(False)
    a, b, c = faces.T
    start, end = jnp.concatenate([a, b, c]), jnp.concatenate([b, c, a])
    back = (start > end).astype(start.dtype)
    # Keys stay apart: their product overflows int32.
    low, high, back = jax.lax.sort(
        (jnp.minimum(start, end), jnp.maximum(start, end), back), num_keys=3
    )
    same = (low[::2] == low[1::2]) & (high[::2] == high[1::2])
    alternate = (back[::2] == 0) & (back[1::2] == 1)
    inside = jnp.all((faces >= 0) & (faces < vertices))
    return inside & jnp.all(same & alternate)


def _cross(u: list[Array], v: list[Array]) -> list[Array]:
    (a, b, c), (x, y, z) = u, v
    return [b * z - c * y, c * x - a * z, a * y - b * x]


def _dot(u: list[Array], v: list[Array]) -> Array:
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@jax.jit
def winds_once(
    vertices: Float[Array, "vertices 3"],
    faces: Int[Array, "faces 3"],
    samples: Int[Array, "samples 3"],
) -> Bool[Array, ""]:
    """Whether the surfaces wind once or not at all around the points on both sides of samples.

    So it is everywhere where they bound a body; around a part inside out they wind -1 times, in
    one that lies within another twice. The winding number is the sum of the faces' solid angles.
    Source: van Oosterom and Strackee, IEEE Trans. Biomed. Eng. 30 (1983) 125-126.
    """
    vertices = jax.lax.stop_gradient(vertices)
    vertices = jnp.where(all_finite(vertices), vertices, 0.0)
    vertices = vertices - jnp.mean(vertices, axis=0)[None, :]
    rounding = ULPS * jnp.finfo(vertices.dtype).eps * jnp.max(jnp.abs(vertices))
    corners = [[vertices[:, i][faces[:, k]] for i in range(3)] for k in range(3)]
    edges = [[p - q for p, q in zip(corners[k], corners[0], strict=True)] for k in (1, 2)]
    normals = _cross(*edges)
    plane = rounding * jnp.sqrt(_dot(normals, normals))

    def fine(sample: Int[Array, "3"]) -> Bool[Array, ""]:
        a, b, c = vertices[sample]
        # Near the corner, where parts that overlap find each other, but on no edge or diagonal.
        point = 0.83 * a + 0.06 * b + 0.11 * c
        normal = jnp.cross(b - a, c - a)
        p, q, r = ([x - point[i] for i, x in enumerate(corner)] for corner in corners)
        lp, lq, lr = (jnp.sqrt(_dot(x, x)) for x in (p, q, r))
        height = _dot(p, normals)
        width = lp * lq * lr + _dot(p, q) * lr + _dot(q, r) * lp + _dot(r, p) * lq
        # Faces that the point lies in, the sample and any twin: half a turn, by side.
        flat = jnp.abs(height) <= plane
        facing = jnp.where(flat & (width < 0), jnp.sign(_dot(normals, list(normal))), 0.0)
        half = 0.5 * jnp.sum(facing)
        rest = jnp.sum(jnp.where(flat, 0.0, jnp.arctan2(height, width))) / (2 * jnp.pi)
        longest = jnp.sqrt(jnp.maximum(jnp.sum((b - a) ** 2), jnp.sum((c - a) ** 2)))
        sliver = jnp.sqrt(jnp.sum(normal * normal)) <= 16 * rounding * longest
        return sliver | ((rest - jnp.abs(half) > -0.25) & (rest + jnp.abs(half) < 1.25))

    return jnp.all(jax.lax.map(fine, samples))
