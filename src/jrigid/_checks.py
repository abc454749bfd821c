"""Input validation: converts arguments, checks shapes and values, raises errors.

Shapes, dtypes and options are checked when a call is traced (ValueError). Values are
checked by `Findings`, in three ways that `docs/design.md` tells apart: a formula is NaN
outside its domain (`where_defined`), a builder raises or is NaN (`Findings.guard`), a
solver or an estimator raises or returns its result code (`settle`). An error is raised
in Python where the values are known, which leaves the compiled function without
callbacks, and by `equinox.error_if` inside of someone's jit. Calls that raise compile
nothing after the first (tests/test_no_leak.py).
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeVar

import diffrax
import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float

from jrigid._core.third_party import (
    EnumerationMeta,
    code_of,
    messages_of,
    names_of,
    unvmap_any,
)

Tree = TypeVar("Tree")

AnyBool = Bool[Array, ""] | np.bool_  # the latter known on the host
INERTIA = (3,), (3, 3)  # shapes of an inertia: principal moments or a tensor


class _Listed(EnumerationMeta):
    """Lists the names of an enumeration, each with a text."""

    def __dir__(cls) -> list[str]:
        return [*super().__dir__(), *names_of(cls)]

    def __getitem__(cls, item: Any) -> Any:
        if isinstance(item, cls):
            code = code_of(item)
            if code.ndim and is_concrete(code):
                return np.array(cls.texts)[np.asarray(code)]  # a text for each lane
        return super().__getitem__(item) or "All went well."

    @property
    def texts(cls) -> list[str]:
        """The texts in the order of the codes."""
        return [x or "All went well." for x in messages_of(cls)]


class Enumeration(eqx.Enumeration, metaclass=_Listed):
    """Codes with a text each, as `equinox.Enumeration`; `dir` lists them."""


class RESULTS(diffrax.RESULTS, metaclass=_Listed):  # pyright: ignore[reportGeneralTypeIssues]
    """What became of a computation: `diffrax.RESULTS` and the ways an input can be wrong."""

    invalid_inertia = (
        "Argument `inertia` must hold three positive, finite principal moments or be a finite, "
        "symmetric, positive definite (3, 3) tensor, but it is not. (Three bodies are three lanes "
        "of `jax.vmap`, not the rows of a (3, 3) array.)"
    )
    invalid_top = (
        "Argument `top` must have I1 > 0, I3 > 0 and a finite mgl, but it has not."
    )
    unphysical_inertia = (
        "Argument `inertia` must be the tensor of a real body, whose principal moments satisfy "
        "I3 <= I1 + I2, but they do not."
    )
    invalid_mass = "Argument `mass` must be positive and finite, but it is not."
    invalid_torque = (
        "A parameter of a torque must be finite, and masses, moments, couplings and drag "
        "coefficients must not be negative, but one is."
    )
    invalid_attitude = (
        "Argument `attitude` must be a unit quaternion, scalar first, but its norm is not 1. "
        "(`jrigid.rotation.normalize` makes it 1.)"
    )
    invalid_state = "Argument `state0` must be finite, but a component is not."
    invalid_times = (
        "Argument `ts` must be finite, and for `simulate` non-decreasing and not earlier than "
        "`t0`, but it is not."
    )
    unresolved_times = (
        "Arguments `t0` and `ts` must be in a dtype that tells apart times within a tenth of a "
        "radian of the motion, but they are not. (Subtract the epoch, so that `t0` is near 0, or "
        "switch on `jax_enable_x64` and pass float64 arrays.)"
    )
    rate_out_of_range = (
        "Arguments `state0` and `system` must give rates whose squares are in the range of their "
        "dtype (1e-146 to 1e146 rad/s in float64, 3e-16 to 6e15 rad/s in float32), but they do "
        "not. (Choose another unit of time.)"
    )
    invalid_max_step = "Argument `max_step` must be positive, but it is not."
    invalid_vector_field = (
        "Argument `system` must have a finite vector field at the initial state, but it is not: "
        "a torque, force or parameter is NaN or infinite there."
    )
    nonfinite_torque = (
        "A torque or a force became NaN or infinite on the way, after `final_time` [s]"
    )
    nonfinite_state = "The motion ran out of the range of floating point numbers."
    no_equilibrium = (
        "Argument `state0` must be an equilibrium in a frame in which the system does not change, "
        "but it is not."
    )
    inaccurate = (
        "Arguments `steps` or `step` must be fine enough for the accuracy of the motion, but they "
        "are not."
    )
    invalid_tolerance = (
        "Arguments `rtol` and `atol` must be below 1 and at least 1e-14 (1e-7 in float32), but "
        "one is not."
    )
    undersampled_rates = (
        "Argument `values` of `Gyro` must be in rad/s and sampled twice a turn, but the body turns "
        "more: are rates in degrees a second, times not in seconds? (1 deg/s is pi / 180 rad/s.)"
    )


def is_good(result: Any) -> bool:
    """Whether a result that is known now is that of a computation which went well."""
    return int(code_of(result)) == int(code_of(RESULTS.successful))


def float_arrays(*values: Any) -> tuple[Array, ...]:
    """Convert to arrays of one floating point dtype, that of the inputs taken together."""
    for value in values:
        if hasattr(value, "inertia"):
            raise ValueError(
                "Argument `inertia` must be three moments or a (3, 3) tensor, but it is a "
                f"{type(value).__name__}: pass its `.inertia`."
            )
    values = tuple(v if eqx.is_array_like(v) else np.asarray(v) for v in values)
    with jax.numpy_dtype_promotion("standard"):
        dtype = jnp.result_type(*values, float)
    return tuple(jnp.asarray(value, dtype) for value in values)


def jumps_within(parts: Any) -> Float[Array, " jumps"]:
    """Times at which something in a pytree declares, by `jumps`, that it is not smooth [s]."""
    leaves = jtu.tree_leaves(parts, is_leaf=lambda x: hasattr(x, "jumps"))
    declared = [x.jumps for x in leaves if hasattr(x, "jumps")]
    known = float_arrays(jnp.zeros(0), *declared)
    return jnp.concatenate([x.reshape(-1) for x in known])


def state_array(value: Any) -> Any:
    """A floating point array; None and integers pass, for the `in_axes` of a state under vmap."""
    return value if value is None or isinstance(value, int) else float_arrays(value)[0]


def internal_parts(internal: Any) -> Any:
    """An internal state; None for `()`, which diffrax cannot save (equinox takes it for a leaf)."""
    return None if isinstance(internal, tuple) and not internal else internal


def check_shape(
    name: str, value: Array | np.ndarray, *shapes: tuple[int | None, ...]
) -> None:
    """Raise ValueError unless `value` has one of the shapes; None stands for any length."""
    for shape in shapes:
        pairs = zip(value.shape, shape, strict=False)
        if len(shape) == value.ndim and all(
            wanted in (None, length) for length, wanted in pairs
        ):
            return
    wanted = " or ".join(str(shape).replace("None", "n") for shape in shapes)
    hint = _hint(name, value.shape, shapes)
    raise ValueError(
        f"Argument `{name}` must have shape {wanted}, but it has shape {value.shape}.{hint}"
    )


def _hint(
    name: str, shape: tuple[int, ...], wanted: Sequence[tuple[int | None, ...]]
) -> str:
    """What a wrong shape may come from."""
    if any(x and shape[len(shape) - len(x) :] == x for x in wanted):
        return " (For many, `jax.vmap`.)"
    if wanted == INERTIA and shape == (6,):
        return (
            " (Six numbers make [[Ixx, Ixy, Ixz], [Ixy, Iyy, Iyz], [Ixz, Iyz, Izz]], whose Ixy is "
            "minus the sum of m x y; programs differ in order and sign.)"
        )
    is_omega = name.endswith("attitude") and shape == (3,)
    return (
        " (`State(attitude, omega)`, the attitude as (w, x, y, z).)" if is_omega else ""
    )


def array_of_shape(name: str, value: Any, *shape: Any) -> Array:
    """Convert to a floating point array, or raise ValueError if the shape is wrong."""
    return shaped(**{name: (value, *shape)})[0]


def shaped(**arguments: tuple[Any, ...]) -> tuple[Array, ...]:
    """Convert arguments to one dtype, or raise ValueError if a shape is wrong.

    Args:
        **arguments: By name: the value, then the lengths of its axes
            (`vector=(vector, 3)`) or the shapes it may have
            (`inertia=(inertia, *INERTIA)`).
    """
    arrays = float_arrays(*(value for value, *_ in arguments.values()))
    for array, (name, (_, *shape)) in zip(arrays, arguments.items(), strict=True):
        several = bool(shape) and isinstance(shape[0], tuple)
        check_shape(name, array, *(shape if several else [tuple(shape)]))
    return arrays


def demand(ok: bool, message: str) -> None:
    """Raise ValueError with a message unless something holds."""
    if not ok:
        raise ValueError(message)


def check_option(name: str, value: Any, options: Sequence[Any]) -> None:
    """Raise ValueError unless `value` is one of `options`."""
    check_known(name, value)
    if value not in options:
        listed = ", ".join(map(repr, options))
        raise ValueError(
            f"Argument `{name}` must be one of {listed}, but it is {value!r}."
        )


def check_type(name: str, value: Any, *types: type) -> None:
    """Raise ValueError unless `value` is of one of the types."""
    if not isinstance(value, types):
        wanted = " or a ".join(x.__name__ for x in types)
        raise ValueError(
            f"Argument `{name}` must be a {wanted}, but it is {kind_of(value)}."
        )


def kind_of(value: Any) -> str:
    """What a wrong argument is, in words."""
    if isinstance(value, type):
        return f"the class `{value.__name__}`, not `{value.__name__}(...)`"
    is_array = eqx.is_array(value) or isinstance(value, np.ndarray)
    return (
        f"an array of shape {value.shape}" if is_array else f"a {type(value).__name__}"
    )


def check_known(name: str, value: Any) -> None:
    """Raise ValueError for an option that is traced: it fixes what is compiled."""
    demand(
        not isinstance(value, jax.core.Tracer),
        f"Argument `{name}` must be known when it is compiled, but it is traced: hand it past "
        "`jit`, `vmap` and `sweep`, in a closure or a Python loop.",
    )


@contextmanager
def traced_by_jax(function: str) -> Iterator[None]:
    """Raise ValueError with what to write instead where a user's function cannot be traced.

    Args:
        function: What it is, in words: "a torque".
    """
    try:
        yield
    except jax.errors.TracerArrayConversionError as error:
        raise ValueError(
            f"Use `jax.numpy` in {function}, not numpy (`jnp.sin`, not `np.sin`): its arguments "
            "are traced by JAX and have no values yet."
        ) from error
    except jax.errors.TracerBoolConversionError as error:
        raise ValueError(
            f"Use `jnp.where` or `jax.lax.cond` in {function}, not `if`, `and` or `max` of Python: "
            "its arguments are traced by JAX and have no values yet."
        ) from error
    except (
        jax.errors.ConcretizationTypeError,
        jax.errors.TracerIntegerConversionError,
    ) as error:
        raise ValueError(
            f"Use `jax.numpy` in {function}, not `math`, `float` or `int` (`jnp.sin`, not "
            "`math.sin`): its arguments are traced by JAX and have no values yet."
        ) from error


def whole_number(name: str, value: Any, least: int = 1) -> int:
    """A Python integer of some size, which fixes a cost at trace time, or ValueError."""
    check_known(name, value)
    if (
        isinstance(value, bool)
        or not isinstance(value, int | np.integer)
        or value < least
    ):
        raise ValueError(
            f"Argument `{name}` must be an integer and at least {least}, but it is {value!r}."
        )
    return int(value)


def is_concrete(value: Any) -> bool:
    """True for a value known now, not a tracer."""
    return isinstance(value, int | float | np.ndarray | np.generic) or (
        eqx.is_array(value) and not isinstance(value, jax.core.Tracer)
    )


def _holds(condition: Callable[[Array], Array], tree: Any) -> Bool[Array, ""]:
    """True where a condition holds for every inexact leaf of a pytree."""
    leaves = [x for x in jtu.tree_leaves(tree) if eqx.is_inexact_array(x)]
    return functools.reduce(
        lambda ok, x: ok & jnp.all(condition(x)), leaves, jnp.array(True)
    )


def all_finite(tree: Any) -> Bool[Array, ""]:
    """True where every inexact leaf of a pytree is finite."""
    return _holds(jnp.isfinite, tree)


def all_positive(tree: Any) -> Bool[Array, ""]:
    """True where every inexact leaf of a pytree is positive and finite."""
    return _holds(lambda x: (x > 0) & jnp.isfinite(x), tree)


def is_unit(quaternion: Float[Array, "4"]) -> Bool[Array, ""]:
    """True where a quaternion is of norm 1 to rounding, be it float32's in float64.

    Four digits typed by hand are not in float64.
    """
    excess = jnp.abs(jnp.sum(jax.lax.stop_gradient(quaternion) ** 2) - 1)
    return excess < max(300 * float(jnp.finfo(quaternion.dtype).eps), 4.5e-7)


def is_symmetric(tensor: Float[Array, "3 3"]) -> Bool[Array, ""]:
    """True where a tensor equals its transpose to rounding."""
    tolerance = 64 * jnp.finfo(tensor.dtype).eps * jnp.max(jnp.abs(tensor))
    return jnp.all(jnp.abs(tensor - tensor.T) <= tolerance)


def scaled_together(
    tensor: Float[Array, "3 3"], *others: Float[Array, "3 3"]
) -> tuple[Float[Array, "3 3"], ...]:
    """Divide tensors by the largest magnitude of the first one's entries, unless 0 or infinite."""
    largest = jnp.max(jnp.abs(tensor))
    # In two steps: XLA flushes the reciprocals of the largest numbers to zero.
    step = jnp.where(largest > 1, 1 / 256, 256).astype(tensor.dtype)
    usable = (largest > 0) & jnp.isfinite(largest)
    divisor = jnp.where(usable, largest * step, 1.0)
    return tuple(x * step / divisor for x in (tensor, *others))


def is_positive_definite(tensor: Float[Array, "3 3"]) -> Bool[Array, ""]:
    """True where the pivots of a symmetric tensor, of whatever scale, are positive."""
    (a, d, e), (_, b, f), (_, _, c) = scaled_together(tensor)[0]
    first = jnp.where(a > 0, a, 1.0)
    b, c, f = b - d * (d / first), c - e * (e / first), f - d * (e / first)
    second = jnp.where(b > 0, b, 1.0)
    return (a > 0) & (b > 0) & (c - f * (f / second) > 0)


def is_inertia(inertia: Array) -> Bool[Array, ""]:
    """True where moments or a tensor can drive the dynamics: finite, symmetric, positive."""
    inertia = jax.lax.stop_gradient(inertia)
    if inertia.ndim == 1:
        return all_positive(inertia)
    return all_finite(inertia) & is_symmetric(inertia) & is_positive_definite(inertia)


def harmless(ok: Array, tree: Tree) -> Tree:
    """Ones, and unit tensors, in place of the arrays of a bad lane.

    Derivatives of NaN are NaN, even those that a mask multiplies by zero: a bad lane
    that went on with its values would spoil the derivatives of what it shares with the
    others.
    """

    def replaced(x: Any) -> Any:
        if not eqx.is_inexact_array(x):
            return x
        return jnp.where(ok, x, jnp.eye(3, dtype=x.dtype) if x.shape == (3, 3) else 1.0)

    return jtu.tree_map(replaced, tree)


def nan_where(bad: AnyBool, tree: Tree) -> Tree:
    """Replace the inexact leaves of a pytree by NaN where `bad`."""
    return jtu.tree_map(
        lambda x: jnp.where(bad, jnp.nan, x) if eqx.is_inexact_array(x) else x, tree
    )


def where_defined(
    ok: Bool[Array, ""], formula: Callable[..., Tree], *arguments: Any
) -> Tree:
    """A formula's values where `ok`, NaN elsewhere; its derivatives stay clean everywhere."""
    return nan_where(~ok, formula(*harmless(ok, arguments)))


class _Diagnosis(NamedTuple):
    """Which condition fails first, and what each condition would report."""

    first: Array  # index into the other two
    messages: tuple[str, ...]
    values: tuple[Any, ...]  # shown behind the message; None for no value


class Findings:
    """Collects what is wrong with the inputs of one call; the first finding wins."""

    def __init__(self) -> None:
        """Start with nothing found."""
        self.ok: Any = np.True_
        self.result: Any = RESULTS.successful
        self._failed: list[AnyBool] = []
        self._messages: list[str] = []
        self._values: list[Any] = []

    def require(
        self, ok: AnyBool, code: Any, message: str | None = None, value: Any = None
    ) -> None:
        """Note what is wrong where `ok` is False.

        Args:
            ok: Whether the condition holds.
            code: The result code, or None in a builder, which keeps no code.
            message: The sentence to report; by default that of the code.
            value: The value to show behind it.
        """
        failed = self.ok & ~ok
        if code is not None:
            if not isinstance(failed, np.bool_):
                self.result = RESULTS.where(failed, code, self.result)
            elif failed:  # known on the host, without a compiled program
                self.result = code
        self.ok = self.ok & ok
        self._failed.append(~ok)
        self._messages.append(str(RESULTS[code] if message is None else message))
        self._values.append(value)

    def guard(self, tree: Tree, throw: bool) -> Tree:
        """Return what a builder made; raise if something is wrong, or NaN without `throw`."""
        check_known("throw", throw)
        if not throw:
            return nan_where(~self.ok, tree)
        return _refuse(tree, ~self.ok, self.diagnosis)

    def diagnosis(self) -> _Diagnosis:
        """Find out which condition fails first; at least one must have been required."""
        first = _first_failed(self._failed)
        return _Diagnosis(first, tuple(self._messages), tuple(self._values))

    def diagnosis_of(self, result: RESULTS) -> _Diagnosis:
        """As `diagnosis`, but where no condition fails the result code tells what is wrong."""
        code = code_of(result)
        first = jnp.where(
            self.ok, len(self._failed) + code, _first_failed(self._failed)
        )
        messages = (*self._messages, *RESULTS.texts)
        values = (*self._values, *[None] * len(RESULTS.texts))
        return _Diagnosis(first, messages, values)


@jax.jit
def _first_failed(failed: list[AnyBool]) -> Array:
    """The index of the first True; 0 if there is none."""
    first = jnp.argmax(jax.lax.stop_gradient(jnp.stack(failed)))
    return first.astype(jnp.int32)  # the type of result codes


def settle(
    answer: Tree,
    throw: bool,
    findings: Callable[..., Findings],
    *arguments: Any,
) -> Tree:
    """Return the answer of a solver or an estimator, or raise if it failed and `throw`.

    What is wrong is looked up by a compiled program of its own, which the next failing
    call uses again. So `findings` must be a function of the module and all else be in
    the arguments: a closure would be compiled, and kept in memory, anew for each error.

    Args:
        answer: With a `result` of `RESULTS`.
        throw: Whether to raise.
        findings: Checks the arguments once more, to tell which of them is wrong.
        arguments: Passed to `findings`: pytrees of arrays and of hashable
            configuration.
    """
    check_known("throw", throw)
    if not throw:
        return answer
    result: Any = answer.result  # pyright: ignore[reportAttributeAccessIssue]
    good = (result == RESULTS.successful) | (result == RESULTS.event_occurred)
    return _refuse(
        answer, ~good, lambda: _diagnosis(findings, ~good, result, *arguments)
    )


@eqx.filter_jit
def _diagnosis(
    findings: Callable[..., Findings], bad: Array, result: RESULTS, *arguments: Any
) -> _Diagnosis:
    """What `findings` and the result code tell of a failed call."""
    found = findings(*arguments).diagnosis_of(result)
    first = jnp.where(bad, found.first, 0)
    values = jax.lax.stop_gradient(jtu.tree_map(jnp.asarray, found.values))
    return _Diagnosis(first, found.messages, values)


def _refuse(tree: Tree, bad: AnyBool, diagnose: Callable[[], _Diagnosis]) -> Tree:
    """Return the tree; raise where `bad`, in Python if that is known, as under vmap and grad."""
    some = unvmap_any(bad)
    if isinstance(some, jax.core.Tracer):
        found = diagnose()
        # Of several bad lanes the last message wins.
        return eqx.branched_error_if(tree, bad, found.first, list(found.messages))
    if not some:
        return tree
    found = diagnose()
    known, firsts = _all_lanes(bad, found.first)
    lane = tuple(np.argwhere(known)[0].tolist())
    first = int(firsts[lane])
    details = []
    if found.values[first] is not None:
        value = jax.lax.stop_gradient(jnp.asarray(found.values[first]))
        details.append(str(_all_lanes(bad, value)[1][lane]))
    if lane:
        others = f" and {known.sum() - 1} more" if known.sum() > 1 else ""
        details.append(f"in lane {lane[0] if len(lane) == 1 else lane}{others}")
    sentence, stop, hint = found.messages[first].partition(". (")
    shown = f": {' '.join(details)}" if details else ""
    raise RuntimeError(sentence.rstrip(".") + shown + (stop or ".") + hint)


def _all_lanes(*values: Any) -> list[np.ndarray]:
    """Values known now, of all lanes of whatever vmap is around; the lanes in front."""
    if not any(isinstance(x, jax.core.Tracer) for x in values):
        return [np.asarray(x) for x in values]
    found: list[np.ndarray] = []

    @jax.custom_batching.custom_vmap
    def look(*values: Any) -> Any:
        return values[0]

    @look.def_vmap
    def _(size: int, batched: list[bool], *values: Any) -> tuple[Any, bool]:
        pairs = zip(values, batched, strict=True)
        found.extend(
            _all_lanes(
                *(x if b else jnp.broadcast_to(x, (size, *x.shape)) for x, b in pairs)
            )
        )
        return values[0], batched[0]

    look(*values)
    return found
