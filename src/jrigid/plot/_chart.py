"""A map of a quantity over two parameters, its regions named and their borders drawn."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jrigid._checks import demand
from jrigid.plot._common import flat_axes

# Pale tints of Okabe and Ito's colours, on which black reads.
_TINTS = "#F6CDA8", "#A6CEE8", "#E4F0C8", "#EBC8DC", "#FFF3A8", "#D4D4D4", "#FFFFFF", "#B8B8E0"
_SHOWN = 2, 98  # percentiles of the values between which the colours run
_NARROW = 0.08  # of the shorter side of the map: regions without room for a name


def chart(
    values: Any, grid: Mapping[str, Any] | None = None, *, ax: Any = None,
    level: float | None = None, regions: Sequence[str] = (), title: str = "",
) -> Any:  # fmt: skip
    """A map over two parameters: regions with names and borders, or numbers by colour and a level.

    Args:
        values: A `SweepResult` of one quantity (of several `result._replace(values=...)`), an
            `xarray.DataArray`, or an array (n, m): numbers, codes of an enumeration, texts,
            integers or booleans. NaN is left white.
        grid: Of an array names (with units) and points of its axes, as for `stability_map`; of
            others new names.
        ax: Axes.
        level: Of numbers, where the border runs: 0 for a growth rate squared.
        regions: Names of what is below and above the level; of integers, of each in its order.
        title: What the numbers are, with their unit.

    Returns:
        The axes.

    Raises:
        ImportError: Without the extra `jrigid[plot]`.
        ValueError: A map that is not over two axes, or of more than eight regions.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> def kind(yaw, roll):
    ...     return jr.stability.satellite_stability(jnp.stack([yaw, roll, 1.0])).region
    >>> ratios = jnp.linspace(0.02, 1.2, 60)
    >>> ax = jr.plot.chart(jr.stability.stability_map(kind, {"yaw": ratios, "roll": ratios}))
    >>> print([text.get_text() for text in ax.texts])
    ['Lagrange', 'undefined', 'unstable']
    """
    (names, points, values), ax = _parts(values, grid), flat_axes(ax)
    from matplotlib import colors, patches
    from scipy import ndimage

    if numbers := values.dtype.kind == "f":
        shown, (low, high), cmap = values, np.nanpercentile(values, _SHOWN), "cividis"
        levels, masks = [level], [] if level is None else [values <= level, values > level]
    else:
        kinds, shown = np.unique(values, return_inverse=True)
        shown, regions = shown.reshape(values.shape), regions or [str(x) for x in kinds]
        low, high, cmap = -0.5, kinds.size - 0.5, colors.ListedColormap(_TINTS[: kinds.size])
        levels, masks = np.arange(kinds.size - 1) + 0.5, [values == x for x in kinds]
    mesh = ax.pcolormesh(*points, shown.T, vmin=low, vmax=high, cmap=cmap, rasterized=True)
    if numbers:
        ax.figure.colorbar(mesh, ax=ax, label=title, extend="both")
    if levels := [x for x in levels if x is not None and np.nanmin(shown) < x < np.nanmax(shown)]:
        ax.contour(*points, shown.T, levels, colors="k", linewidths=1.0)
    box = {"facecolor": "w", "alpha": 0.75 * numbers, "lw": 0, "boxstyle": "round,pad=0.2"}
    small: list[Any] = []
    for mask, name, tint in zip(masks, regions, _TINTS, strict=False):
        room: Any = ndimage.distance_transform_edt(np.pad(mask, 1))
        if np.max(room) > _NARROW * min(values.shape):
            place = np.unravel_index(np.argmax(room), room.shape)
            at = [x[k - 1] for x, k in zip(points, place, strict=True)]
            ax.text(*at, name, ha="center", va="center", bbox=box)
        elif not numbers:
            small.append(patches.Patch(facecolor=tint, edgecolor="k", label=name))
    if small:
        ax.legend(handles=small, loc="lower right", bbox_to_anchor=(1, 1), ncols=4, frameon=False)
    ax.set(xlabel=names[0], ylabel=names[1])
    ax.set_title("" if numbers else title, loc="left")
    return ax


def _parts(values: Any, grid: Mapping[str, Any] | None) -> tuple[Any, Any, np.ndarray]:
    """Names of the axes with units, their points, and the values as numbers or texts."""
    axes, about = dict(grid or {}), {}
    if hasattr(values, "axes"):  # a SweepResult
        axes, about, values = values.axes, values.attributes, values.values
    elif hasattr(values, "coords"):  # xarray's
        axes, texts = {x: values[x].values for x in values.dims}, values.attrs.get("flag_meanings")
        about = {x: values[x].attrs for x in axes}
        values = values.values if texts is None else np.array(texts.split())[values.values]
    codes = getattr(values, "_enumeration", None)
    values = np.asarray(values if codes is None else codes[values])
    ok = values.ndim == 2 and values.shape == tuple(np.size(x) for x in axes.values())
    ok &= values.dtype.kind == "f" or np.unique(values).size <= len(_TINTS)
    demand(ok, "Argument `values` must be over two axes, of few regions, but it is not.")
    units = [about.get(x, {}).get("units") for x in axes]
    names = [f"{x} [{unit}]" if unit else x for x, unit in zip(grid or axes, units, strict=True)]
    return names, list(axes.values()), values
