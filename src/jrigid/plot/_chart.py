"""A map of a quantity over two parameters, its regions named and their borders drawn."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jrigid._checks import demand
from jrigid._core.third_party import EnumerationItem, code_of, enumeration_of
from jrigid.plot._common import flat_axes

# Pale tints of Okabe and Ito's colours, on which black reads.
_TINTS = (
    "#F6CDA8",
    "#A6CEE8",
    "#E4F0C8",
    "#EBC8DC",
    "#FFF3A8",
    "#D4D4D4",
    "#FFFFFF",
    "#B8B8E0",
)
_SHOWN = 2, 98  # percentiles of the values between which the colours run
_NARROW = 0.08  # of the shorter side of the map: regions without room for a name


def chart(
    values: Any,
    grid: Mapping[str, Any] | None = None,
    *,
    ax: Any = None,
    level: float | None = None,
    regions: Sequence[str] = (),
    title: str = "",
) -> Any:
    """A map over two parameters: regions with names and borders, or numbers by colour and a level.

    Args:
        values: A `SweepResult` of one quantity (of several
            `result._replace(values=...)`), an `xarray.DataArray`, or an array (n, m):
            numbers, codes of an enumeration, texts, integers or booleans. NaN is left
            white.
        grid: Of an array names (with units) and points of its axes, as for
            `stability_map`; of others new names.
        ax: Axes.
        level: Of numbers, where the border runs: 0 for a growth rate squared.
        regions: Names of what is below and above the level; of integers, booleans and
            codes, that of code 0, of code 1 and so on, be they on the map or not. A
            code keeps its tint on every map; where codes exceed seven, and of texts,
            tints go by the order of those there.
        title: What the numbers are, with their unit.

    Returns:
        The axes.

    Raises:
        ImportError: Without the extra `jrigid[plot]`.
        ValueError: A map that is not over two axes, of several quantities, or of more
            than eight regions, or regions without names.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> def kind(yaw, roll):
    ...     return jr.stability.satellite_stability(jnp.stack([yaw, roll, 1.0])).region
    >>> ratios = jnp.linspace(0.02, 1.2, 60)
    >>> ax = jr.plot.chart(jr.stability.stability_map(kind, {"yaw": ratios, "roll": ratios}))
    >>> print([text.get_text() for text in ax.texts])
    ['unstable', 'Lagrange', 'undefined']
    """
    from matplotlib import colors, patches
    from scipy import ndimage

    names, points, values, kinds = _parts(values, grid)
    if numbers := values.dtype.kind == "f":
        masks = [] if level is None else [values <= level, values > level]
        wrong = "Argument `regions` must name what is below and above a `level`, but it does not."
        demand(len(regions) in (0, len(masks)), wrong)
        (low, high), cmap, tints = np.nanpercentile(values, _SHOWN), "cividis", _TINTS
        borders = [(values, level)] * bool(min(map(np.any, masks), default=False))
    else:
        demand(
            level is None,
            "Argument `level` must be left out for regions, but it is not.",
        )
        values, present, regions = _regions(values, kinds, regions)
        low, high, cmap = -0.5, len(_TINTS) - 0.5, colors.ListedColormap(_TINTS)
        masks, tints = [values == x for x in present], [_TINTS[x] for x in present]
        borders = [(mask, 0.5) for mask in masks[:-1]]
    ax = flat_axes(ax)
    mesh = ax.pcolormesh(
        *points, values.T, vmin=low, vmax=high, cmap=cmap, rasterized=True
    )
    if numbers:
        ax.figure.colorbar(mesh, ax=ax, label=title, extend="both")
    for field, border in borders:
        ax.contour(*points, field.T, [border], colors="k", linewidths=1.0)
    box = {
        "facecolor": "w",
        "alpha": 0.75 * numbers,
        "lw": 0,
        "boxstyle": "round,pad=0.2",
    }
    small: list[Any] = []
    for mask, name, tint in zip(masks, regions, tints, strict=False):
        room: Any = ndimage.distance_transform_edt(np.pad(mask, 1))
        if np.max(room) > _NARROW * min(values.shape):
            place = np.unravel_index(np.argmax(room), room.shape)
            at = [x[k - 1] for x, k in zip(points, place, strict=True)]
            ax.text(*at, name, ha="center", va="center", bbox=box)
        elif not numbers:
            small.append(patches.Patch(facecolor=tint, edgecolor="k", label=name))
    if small:
        ax.legend(
            handles=small,
            loc="lower right",
            bbox_to_anchor=(1, 1),
            ncols=4,
            frameon=False,
        )
    ax.set(xlabel=names[0], ylabel=names[1])
    ax.set_title("" if numbers else title, loc="left")
    return ax


def _regions(
    values: Any, kinds: Any, regions: Sequence[str]
) -> tuple[np.ndarray, Any, list[str]]:
    """The number of the tint everywhere, the numbers that are there, and their names."""
    if values.dtype.kind not in "biu":
        demand(
            not regions, "Argument `regions` must be left out for texts, but it is not."
        )
        kinds, values = np.unique(values, return_inverse=True)
    present, ranks = np.unique(values.astype(int), return_inverse=True)
    least, most, few = present[0], present[-1], present.size <= len(_TINTS)
    demand(few, f"Argument `values` must be of few regions, but it has {present.size}.")
    named = not regions or bool(0 <= least <= most < len(regions))
    demand(
        named, f"Argument `regions` must name the codes 0 to {most}, but it does not."
    )
    texts = regions or kinds
    names = [str(x if texts is None else texts[x]) for x in present]
    if least < 0 or most >= len(_TINTS):  # more codes than tints
        return ranks.reshape(values.shape), range(present.size), names
    return values, present, names


def _parts(
    values: Any, grid: Mapping[str, Any] | None
) -> tuple[Any, Any, np.ndarray, Any]:
    """Names of the axes with units, their points, numbers, codes or texts, names of the codes."""
    axes, about, kinds = dict(grid or {}), {}, None
    if hasattr(values, "axes"):  # a SweepResult
        axes, about, values = values.axes, values.attributes, values.values
    several = (
        ", ".join(values) if hasattr(values, "keys") else ""
    )  # also xarray's Dataset
    demand(
        not several,
        f"Argument `values` must be one quantity, but it is several: {several}.",
    )
    if hasattr(values, "coords"):  # xarray's
        axes, texts = (
            {x: values[x].values for x in values.dims},
            values.attrs.get("flag_meanings"),
        )
        about, kinds = {x: values[x].attrs for x in axes}, texts and texts.split()
        values = values.values
    if isinstance(values, EnumerationItem):
        kinds = enumeration_of(values).texts
        values = code_of(values)
    values, shape = np.asarray(values), tuple(np.size(x) for x in axes.values())
    kinds = ("False", "True") if values.dtype.kind == "b" else kinds
    ok = (
        len(grid or axes) == values.ndim == 2
        and values.shape == shape
        and min(shape) > 1
    )
    wanted = "Argument `values` must be over two axes with the points of `grid`, two at least"
    demand(ok, f"{wanted}, but its shape is {values.shape} and that of `grid` {shape}.")
    units = [about.get(x, {}).get("units") for x in axes]
    names = [
        f"{x} [{unit}]" if unit else x
        for x, unit in zip(grid or axes, units, strict=True)
    ]
    return names, list(axes.values()), values, kinds
