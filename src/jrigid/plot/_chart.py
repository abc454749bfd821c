"""A map of a quantity over two parameters, with names and borders of its regions."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from jrigid._checks import demand
from jrigid._core.third_party import EnumerationItem, code_of, enumeration_of
from jrigid._types import AnyArray
from jrigid.plot._drawing import Axes, flat_axes
from jrigid.sweep import SweepResult

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
_PERCENTILES = 2, 98  # of the values, between which the colours run
_NARROW = 0.08  # of the shorter side of the map: regions without room for a name


@runtime_checkable
class _DataArray(Protocol):
    """Attributes that are used of xarray's `DataArray`; xarray is an extra."""

    dims: tuple[str, ...]
    coords: Mapping[str, Any]
    attrs: Mapping[str, Any]
    values: np.ndarray

    def __getitem__(self, name: str) -> Any:
        """A coordinate."""
        ...


class _Map(NamedTuple):
    """A quantity over two axes.

    Attributes:
        names: Of the axes, with units.
        points: Of the axes.
        values: Numbers, codes or texts (n, m).
        kinds: Names of the codes, if they have any.
    """

    names: list[str]
    points: list[Any]
    values: np.ndarray
    kinds: Sequence[str] | np.ndarray | None


class _Region(NamedTuple):
    """Region in which a map has one value, or is on one side of a level."""

    name: str
    mask: np.ndarray
    tint: str


def chart(
    values: object,
    grid: Mapping[str, AnyArray] | None = None,
    *,
    ax: Axes | None = None,
    level: float | None = None,
    regions: Sequence[str] = (),
    title: str = "",
) -> Axes:
    """Draw a map over two parameters: named regions, or numbers by colour with a level.

    Args:
        values: A `SweepResult` of one quantity (of several
            `result._replace(values=...)`), an `xarray.DataArray`, or an array (n, m):
            numbers, codes of an enumeration, texts, integers or booleans. NaN,
            infinity and what is masked are left white. Of a refined map the classes are
            drawn.
        grid: Of an array names (with units) and points of its axes, as for
            `stability_map`; of others new names.
        ax: Axes.
        level: Of numbers, where the border runs: 0 for a growth rate squared.
        regions: Names of what is below and above the level; of integers, booleans and
            codes, that of code 0, of code 1 and so on, be they on the map or not. A
            code has the same tint on every map. Where codes exceed seven, and for
            texts, tints go by the order of those on the map.
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
    >>> grid = {"yaw": ratios, "roll": ratios}
    >>> ax = jr.plot.chart(jr.stability.stability_map(kind, grid))
    >>> print([text.get_text() for text in ax.texts])
    ['unstable', 'Lagrange', 'undefined']
    """
    values_on = _map_of(values, grid)
    if values_on.values.dtype.kind == "f":
        sides = _sides(values_on.values, level, regions)
        ax = flat_axes(ax)
        _draw_numbers(ax, values_on, title)
        # matplotlib warns of a level that the map does not reach.
        if min((np.any(x.mask) for x in sides), default=False):
            _draw_border(ax, values_on, values_on.values, level)
        _name(ax, values_on, sides, box_alpha=0.75)
        title = ""  # it is that of the colour bar
    else:
        message = "Argument `level` must be left out for regions, but it is not."
        demand(level is None, message)
        codes, on_map = _regions(values_on, regions)
        ax = flat_axes(ax)
        _draw_codes(ax, values_on, codes)
        # Each border of the last region is also one of another region.
        for region in on_map[:-1]:
            _draw_border(ax, values_on, region.mask, 0.5)
        _list_beside(ax, _name(ax, values_on, on_map, box_alpha=0.0))
    ax.set(xlabel=values_on.names[0], ylabel=values_on.names[1])
    ax.set_title(title, loc="left")
    return ax


def _sides(
    values: np.ndarray, level: float | None, names: Sequence[str]
) -> list[_Region]:
    """Regions below and above a level, if there is one."""
    # NaN is on neither side.
    masks = [] if level is None else [values <= level, values > level]
    needed = "must name what is below and above a `level`"
    message = f"Argument `regions` {needed}, but it does not."
    demand(len(names) in (0, len(masks)), message)
    names = names or [""] * len(masks)
    pairs = zip(names, masks, strict=True)
    return [_Region(name, mask, _TINTS[0]) for name, mask in pairs]


def _draw_numbers(ax: Axes, drawn: _Map, title: str) -> None:
    """Draw numbers by colour, with a colour bar."""
    colours: dict[str, Any] = {"cmap": "cividis"}
    # A percentile beside infinity would be infinite or NaN.
    finite = drawn.values[np.isfinite(drawn.values)]
    if finite.size:
        colours["vmin"], colours["vmax"] = np.percentile(finite, _PERCENTILES)
    mesh = ax.pcolormesh(*drawn.points, drawn.values.T, rasterized=True, **colours)
    ax.figure.colorbar(mesh, ax=ax, label=title, extend="both")


def _draw_codes(ax: Axes, drawn: _Map, codes: np.ndarray) -> None:
    """Draw each code in its tint."""
    from matplotlib.colors import ListedColormap

    # Then code k is in the middle of tint k.
    colours: dict[str, Any] = {"vmin": -0.5, "vmax": len(_TINTS) - 0.5}
    colours["cmap"] = ListedColormap(_TINTS)
    ax.pcolormesh(*drawn.points, codes.T, rasterized=True, **colours)


def _draw_border(ax: Axes, drawn: _Map, field: np.ndarray, level: float | None) -> None:
    """Draw where a field crosses a level."""
    ax.contour(*drawn.points, field.T, [level], colors="k", linewidths=1.0)


def _name(
    ax: Axes, drawn: _Map, regions: list[_Region], box_alpha: float
) -> list[_Region]:
    """Write each region's name where it is widest; those without room are returned."""
    # Imported where it is used: scipy would add a second to `import jrigid`.
    from scipy import ndimage

    box: dict[str, Any] = {"facecolor": "w", "alpha": box_alpha, "lw": 0}
    box["boxstyle"] = "round,pad=0.2"
    narrow = []
    for region in regions:
        # Padded, so that the edge of the map counts as a border.
        room: Any = ndimage.distance_transform_edt(np.pad(region.mask, 1))
        if np.max(room) > _NARROW * min(drawn.values.shape):
            place = np.unravel_index(np.argmax(room), room.shape)
            # The padding has moved all places by one.
            x, y = (x[k - 1] for x, k in zip(drawn.points, place, strict=True))
            if region.name:
                ax.text(x, y, region.name, ha="center", va="center", bbox=box)
        else:
            narrow.append(region)
    return narrow


def _list_beside(ax: Axes, regions: list[_Region]) -> None:
    """List regions in a legend above the map."""
    from matplotlib.patches import Patch

    handles = [Patch(facecolor=x.tint, edgecolor="k", label=x.name) for x in regions]
    if handles:
        place: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1, 1)}
        ax.legend(handles=handles, ncols=4, frameon=False, **place)


def _regions(drawn: _Map, names: Sequence[str]) -> tuple[np.ndarray, list[_Region]]:
    """The number of the tint everywhere, and the regions that are on the map."""
    values = drawn.values
    kinds = names or drawn.kinds
    if values.dtype.kind not in "biu":
        message = "Argument `regions` must be left out for texts, but it is not."
        demand(not names, message)
        kinds, values = np.unique(values, return_inverse=True)
        # The shape of the inverse depends on the version of NumPy.
        values = values.reshape(drawn.values.shape)
    present, ranks = np.unique(values.astype(int), return_inverse=True)
    message = f"Argument `values` must be of few regions, but it has {present.size}."
    demand(present.size <= len(_TINTS), message)
    least = present[0]
    most = present[-1]
    are_named = not names or bool(0 <= least <= most < len(names))
    message = f"Argument `regions` must name the codes 0 to {most}, but it does not."
    demand(are_named, message)
    texts = [str(x if kinds is None else kinds[x]) for x in present]
    if least < 0 or most >= len(_TINTS):  # more codes than tints
        values = ranks.reshape(values.shape)
        present = np.arange(present.size)
    tinted = zip(texts, present, strict=True)
    return values, [_Region(text, values == x, _TINTS[x]) for text, x in tinted]


def _unmasked(values: Any) -> np.ndarray:
    """Values as an array, NaN where numbers are masked."""
    array = np.asarray(values)
    message = f"Argument `values` must be real or codes, but it is of {array.dtype}."
    demand(array.dtype.kind not in "cOMm", message)
    if not np.ma.is_masked(values):
        return array
    message = "Argument `values` must hold floats where it is masked, but it does not."
    demand(array.dtype.kind == "f", message)
    return np.ma.filled(values, np.nan)


def _demand_one_quantity(values: object) -> None:
    """Raise ValueError for several quantities: a mapping or a named tuple of them."""
    # Also xarray's Dataset is a mapping.
    names = values if isinstance(values, Mapping) else getattr(values, "_fields", ())
    several = ", ".join(names)
    message = f"Argument `values` must be one quantity, but it is several: {several}."
    demand(not several, message)


def _map_of(values: object, grid: Mapping[str, AnyArray] | None) -> _Map:
    """The axes and values of a map, checked."""
    axes: Mapping[str, Any] = grid or {}
    about: Mapping[str, Mapping[str, str]] = {}
    kinds: Any = None
    if isinstance(values, SweepResult):
        axes = values.axes
        about = values.attributes
        # The values of a refined map are not known everywhere.
        is_refined = values.classes is not None
        kinds = values.class_names or None
        values = values.classes if is_refined else values.values
    _demand_one_quantity(values)
    if isinstance(values, _DataArray):
        axes = {x: values[x].values for x in values.dims}
        about = {x: values[x].attrs for x in values.dims}
        meanings = values.attrs.get("flag_meanings")
        kinds = meanings.split() if meanings else None
        values = values.values
    if isinstance(values, EnumerationItem):
        kinds = enumeration_of(values).texts
        values = code_of(values)
    array = _unmasked(values)
    kinds = ("False", "True") if array.dtype.kind == "b" else kinds
    shape = tuple(np.size(x) for x in axes.values())
    titles = grid or axes
    is_map = len(titles) == array.ndim == 2 and array.shape == shape and min(shape) > 1
    needed = "must be over two axes with the points of `grid`, two at least"
    message = f"but its shape is {array.shape} and that of `grid` {shape}."
    demand(is_map, f"Argument `values` {needed}, {message}")
    units = [about.get(x, {}).get("units") for x in axes]
    pairs = zip(titles, units, strict=True)
    names = [f"{x} [{unit}]" if unit else x for x, unit in pairs]
    return _Map(names, list(axes.values()), array, kinds)
