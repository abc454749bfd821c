"""Input validation: converts arguments, checks shapes and values, raises errors.

Shapes, dtypes and options are checked when a call is traced (ValueError). Values are
checked by `Findings`, and handled in one of three ways, which
`docs/contributing/architecture.md` explains. A formula is NaN outside its domain
(`where_defined`). A builder raises an error or returns NaN (`Findings.guard`). A solver
or an estimator raises an error or returns a result code (`settle`). Where the values
are known, the error is raised in Python, so that the compiled function has no
callbacks. In a user's own jit `equinox.error_if` raises it. After the first failed
call no other compiles anything (tests/test_no_leak.py).
"""

import functools
import inspect
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeVar

import diffrax
import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jrigid._core.compile import quick_jit
from jrigid._core.third_party import (
    EnumerationMeta,
    code_of,
    messages_of,
    names_of,
    unvmap_any,
)

Tree = TypeVar("Tree")

#: A boolean of JAX, or one of numpy, which is known on the host.
AnyBool = Bool[Array, ""] | np.bool_
# Shapes of an inertia: principal moments or a tensor.
INERTIA = ((3,), (3, 3))


class _Listed(EnumerationMeta):
    """Lists the names of an enumeration, each with a text."""

    def __dir__(cls) -> list[str]:
        return [*super().__dir__(), *names_of(cls)]

    def __getitem__(cls, item: object) -> Any:
        if isinstance(item, cls):
            code = code_of(item)
            if code.ndim and is_concrete(code):
                # A text for each lane.
                return np.array(cls.texts)[np.asarray(code)]
        # The text of `successful` is empty in diffrax.
        return super().__getitem__(item) or "All went well."

    @property
    def texts(cls) -> list[str]:
        """The texts in the order of the codes."""
        return [x or "All went well." for x in messages_of(cls)]


class Enumeration(eqx.Enumeration, metaclass=_Listed):
    """Codes with a text each, as `equinox.Enumeration`; `dir` lists them."""


class RESULTS(
    # pyright takes it for an enum, which has no subclasses.
    diffrax.RESULTS,  # pyright: ignore[reportGeneralTypeIssues]
    metaclass=_Listed,
):
    """Result codes: those of `diffrax.RESULTS`, and codes for invalid input."""

    invalid_inertia = (
        "Argument `inertia` must hold three positive, finite principal moments or be a "
        "finite, symmetric, positive definite (3, 3) tensor, but it is not. (Three "
        "bodies are three lanes of `jax.vmap`, not the rows of a (3, 3) array.)"
    )
    invalid_top = (
        "Argument `top` must have I1 > 0, I3 > 0 and a finite mgl, but it has not."
    )
    unphysical_inertia = (
        "Argument `inertia` must be the tensor of a real body, whose principal moments "
        "satisfy I3 <= I1 + I2, but they do not."
    )
    invalid_mass = "Argument `mass` must be positive and finite, but it is not."
    invalid_torque = (
        "A parameter of a torque must be finite, and masses, moments, couplings and "
        "drag coefficients must not be negative, but one is."
    )
    invalid_attitude = (
        "Argument `attitude` must be a unit quaternion, scalar first, but its norm is "
        "not 1. (`jrigid.rotation.normalize` makes it 1.)"
    )
    invalid_state = "Argument `state0` must be finite, but a component is not."
    invalid_times = (
        "Argument `ts` must be finite, and for `simulate` non-decreasing and not "
        "earlier than `t0`, but it is not."
    )
    unresolved_times = (
        "Arguments `t0` and `ts` must be in a dtype that tells apart times within a "
        "tenth of a radian of the motion, but they are not. (Subtract the epoch, so "
        "that `t0` is near 0, or switch on `jax_enable_x64` and pass float64 arrays.)"
    )
    rate_out_of_range = (
        "Arguments `state0` and `system` must give rates whose squares are in the "
        "range of their dtype (1e-146 to 1e146 rad/s in float64, 3e-16 to 6e15 rad/s "
        "in float32), but they do not. (Choose another unit of time.)"
    )
    invalid_max_step = "Argument `max_step` must be positive, but it is not."
    invalid_vector_field = (
        "Argument `system` must have a finite vector field at the initial state, but "
        "it is not: a torque, force or parameter is NaN or infinite there."
    )
    nonfinite_torque = (
        "A torque or a force became NaN or infinite on the way, after `final_time` [s]"
    )
    nonfinite_state = "The motion ran out of the range of floating point numbers."
    no_equilibrium = (
        "Argument `state0` must be an equilibrium in a frame in which the system does "
        "not change, but it is not."
    )
    inaccurate = (
        "Arguments `steps` or `step` must be fine enough for the accuracy of the "
        "motion, but they are not. (Equal steps pass over the jumps of a torque, where "
        "`simulate` ends steps. Of exponents, `every` may be too large instead.)"
    )
    invalid_tolerance = (
        "Arguments `rtol` and `atol` must be below 1 and at least 1e-14 (1e-7 in "
        "float32), but one is not."
    )
    invalid_observations = (
        "Argument `observations` must hold 12 numbers at least, values of unit length "
        "where they are attitudes or directions, and a positive noise, but it does not."
    )
    undersampled_rates = (
        "Argument `values` of `Gyro` must be in rad/s and sampled twice a turn, but "
        "the body turns more: are rates in degrees a second, times not in seconds? (1 "
        "deg/s is pi / 180 rad/s.)"
    )


def is_good(result: RESULTS) -> bool:
    """Whether a result that is known now is `successful`."""
    return int(code_of(result)) == int(code_of(RESULTS.successful))


def float_arrays(*values: Any) -> tuple[Array, ...]:
    """Convert to arrays of one floating point dtype, that of all inputs together."""
    # Under strict dtype promotion arguments of different dtypes would be an error.
    with jax.numpy_dtype_promotion("standard"):
        # `jnp.result_type` accepts arrays and numbers, but no lists.
        values = tuple(v if eqx.is_array_like(v) else _from_list(v) for v in values)
        # `float` makes floats of integers and leaves float32 as it is.
        dtype = jnp.result_type(*values, float)
    if jnp.issubdtype(dtype, jnp.complexfloating):
        raise ValueError(f"Arguments must be real numbers, but one is {dtype}.")
    return tuple(jnp.asarray(value, dtype) for value in values)


def _from_list(value: Any) -> Array | np.ndarray:
    """An array of numbers in lists, or ValueError for what is no number."""
    for name in ("inertia", "as_rigid_body().inertia"):
        if hasattr(value, name.split("(")[0]):
            raise ValueError(
                "Argument `inertia` must be three moments or a (3, 3) tensor, but it "
                f"is a {type(value).__name__}: pass its `.{name}`."
            )
    is_list = isinstance(value, list | tuple)
    if is_list and any(isinstance(x, jax.core.Tracer) for x in jtu.tree_leaves(value)):
        return jnp.asarray(value)
    array = np.asarray(value)
    demand(
        array.dtype != object,
        f"Arguments must be numbers or arrays, but one is {kind_of(value)}.",
    )
    return array


def jumps_within(parts: PyTree) -> Float[Array, " jumps"]:
    """Times that the parts of a pytree declare by a property `jumps` [s]."""
    # A part declares its jumps as a whole, so its own parts do not count again.
    leaves = jtu.tree_leaves(parts, is_leaf=lambda x: hasattr(x, "jumps"))
    declared = [x.jumps for x in leaves if hasattr(x, "jumps")]
    # The empty array is the result where no part declares jumps.
    known = float_arrays(jnp.zeros(0), *declared)
    return jnp.concatenate([x.reshape(-1) for x in known])


def state_array(value: Any) -> Any:
    """Convert to a floating point array, except None and integers.

    These occur in a state that holds the `in_axes` of `jax.vmap`.
    """
    return value if value is None or isinstance(value, int) else float_arrays(value)[0]


def internal_parts(internal: PyTree) -> PyTree:
    """The internal state, a list as a tuple, and None in place of an empty one.

    diffrax cannot save `()`, since equinox takes it for a leaf.
    """
    if isinstance(internal, list):
        internal = tuple(internal)
    return None if isinstance(internal, tuple) and not internal else internal


def check_shape(
    name: str, value: Array | np.ndarray, *shapes: tuple[int | None, ...]
) -> None:
    """Raise ValueError unless `value` has one of the shapes; None is any length."""
    for shape in shapes:
        pairs = zip(value.shape, shape, strict=False)
        if len(shape) == value.ndim and all(
            wanted in (None, length) for length, wanted in pairs
        ):
            return
    wanted = " or ".join(str(shape).replace("None", "n") for shape in shapes)
    hint = _hint(name, value.shape, shapes)
    raise ValueError(
        f"Argument `{name}` must have shape {wanted}, "
        f"but it has shape {value.shape}.{hint}"
    )


def _hint(
    name: str, shape: tuple[int, ...], wanted: Sequence[tuple[int | None, ...]]
) -> str:
    """A hint at the usual mistake behind a wrong shape."""
    # If the last axes are right, those before them are a batch.
    if any(x and shape[len(shape) - len(x) :] == x for x in wanted):
        return " (For many, `jax.vmap`.)"
    if wanted == INERTIA and shape == (6,):
        return (
            " (Six numbers make [[Ixx, Ixy, Ixz], [Ixy, Iyy, Iyz], [Ixz, Iyz, Izz]], "
            "whose Ixy is minus the sum of m x y; programs differ in order and sign.)"
        )
    is_omega = name.endswith("attitude") and shape == (3,)
    return (
        " (`State(attitude, omega)`, the attitude as (w, x, y, z).)" if is_omega else ""
    )


def array_of_shape(
    name: str, value: object, *shape: int | tuple[int | None, ...] | None
) -> Array:
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
        # `vector=(vector, 3)` has the lengths of one shape, `inertia` has several
        # shapes.
        several = bool(shape) and isinstance(shape[0], tuple)
        check_shape(name, array, *(shape if several else [tuple(shape)]))
    return arrays


def demand(ok: bool, message: str) -> None:
    """Raise ValueError with a message unless something holds."""
    if not ok:
        raise ValueError(message)


def check_option(name: str, value: object, options: Sequence[object]) -> None:
    """Raise ValueError unless `value` is one of `options`."""
    check_known(name, value)
    if value not in options:
        listed = ", ".join(map(repr, options))
        raise ValueError(
            f"Argument `{name}` must be one of {listed}, but it is {value!r}."
        )


def check_type(name: str, value: object, *types: type) -> None:
    """Raise ValueError unless `value` is of one of the types."""
    if not isinstance(value, types):
        wanted = " or a ".join(x.__name__ for x in types)
        raise ValueError(
            f"Argument `{name}` must be a {wanted}, but it is {kind_of(value)}."
        )


def check_key(name: str, value: Any) -> None:
    """Raise ValueError unless `value` is one random key, of either kind of JAX."""
    is_key = isinstance(value, jax.Array) and (
        jnp.issubdtype(value.dtype, jax.dtypes.prng_key)
        or (value.dtype == jnp.uint32 and value.ndim == 1)
    )
    demand(
        is_key,
        f"Argument `{name}` must be a random key, such as `jax.random.key(0)`, but it "
        f"is {kind_of(value)}.",
    )


def kind_of(value: Any) -> str:
    """The kind of a wrong argument, in words."""
    if isinstance(value, type):
        return f"the class `{value.__name__}`, not `{value.__name__}(...)`"
    if eqx.is_array(value) or isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    return f"a {type(value).__name__}"


def check_known(name: str, value: object) -> None:
    """Raise ValueError for an option that is traced: it fixes what is compiled."""
    demand(
        not isinstance(value, jax.core.Tracer),
        f"Argument `{name}` must be known when it is compiled, but it is traced: "
        "hand it past `jit`, `vmap` and `sweep`, in a closure or a Python loop.",
    )


def can_be_called(
    function: Callable[..., Any], *positional: object, **named: object
) -> bool:
    """Whether a function takes such arguments, or may take them."""
    try:
        inspect.signature(function).bind(*positional, **named)
    except ValueError:  # The signature of a function written in C is not known.
        return True
    except TypeError:
        return False
    return True


@contextmanager
def traced_by_jax(function: str) -> Generator[None, None, None]:
    """Raise a helpful ValueError if a user's function cannot be traced.

    Args:
        function: The kind of the function in words: "a torque".
    """
    try:
        yield
    except jax.errors.TracerArrayConversionError as error:
        raise ValueError(
            f"Use `jax.numpy` in {function}, not numpy (`jnp.sin`, not `np.sin`): its "
            "arguments are traced by JAX and have no values yet."
        ) from error
    # This error is also a `ConcretizationTypeError`, so that it must come first.
    except jax.errors.TracerBoolConversionError as error:
        raise ValueError(
            f"Use `jnp.where` or `jax.lax.cond` in {function}, not `if`, `and` or "
            "`max` of Python: its arguments are traced by JAX and have no values yet."
        ) from error
    except (
        jax.errors.ConcretizationTypeError,
        jax.errors.TracerIntegerConversionError,
    ) as error:
        raise ValueError(
            f"Use `jax.numpy` in {function}, not `math`, `float` or `int` (`jnp.sin`, "
            "not `math.sin`): its arguments are traced by JAX and have no values yet."
        ) from error


def whole_number(name: str, value: Any, least: int = 1) -> int:
    """A Python integer, known when traced and at least `least`, or ValueError."""
    check_known(name, value)
    # In Python True is an integer too.
    is_integer = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not is_integer or value < least:
        raise ValueError(
            f"Argument `{name}` must be an integer and at least {least}, "
            f"but it is {value!r}."
        )
    return int(value)


def is_concrete(value: object) -> bool:
    """True for a value known now, not a tracer."""
    return isinstance(value, int | float | np.ndarray | np.generic) or (
        eqx.is_array(value) and not isinstance(value, jax.core.Tracer)
    )


def _holds(condition: Callable[[Array], Array], tree: PyTree) -> Bool[Array, ""]:
    """True where a condition holds for every inexact leaf of a pytree."""
    leaves = [x for x in jtu.tree_leaves(tree) if eqx.is_inexact_array(x)]
    return functools.reduce(
        lambda ok, x: ok & jnp.all(condition(x)), leaves, jnp.array(True)
    )


def all_finite(tree: PyTree) -> Bool[Array, ""]:
    """True where every inexact leaf of a pytree is finite."""
    return _holds(jnp.isfinite, tree)


def all_positive(tree: PyTree) -> Bool[Array, ""]:
    """True where every inexact leaf of a pytree is positive and finite."""

    def is_positive(x: Array) -> Array:
        return (x > 0) & jnp.isfinite(x)

    return _holds(is_positive, tree)


def is_unit(quaternion: Float[Array, "4"]) -> Bool[Array, ""]:
    """True where a quaternion has norm 1 to rounding, also to that of float32.

    Four digits typed by hand are not enough in float64.
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
    """Divide tensors by the largest magnitude of the first one's entries.

    If that is zero or infinite, the tensors do not change.
    """
    largest = jnp.max(jnp.abs(tensor))
    # In two steps: XLA flushes the reciprocals of the largest numbers to zero.
    step = jnp.where(largest > 1, 1 / 256, 256).astype(tensor.dtype)
    usable = (largest > 0) & jnp.isfinite(largest)
    divisor = jnp.where(usable, largest * step, 1.0)
    return tuple(x * step / divisor for x in (tensor, *others))


def is_positive_definite(tensor: Float[Array, "3 3"]) -> Bool[Array, ""]:
    """True where the pivots of a symmetric tensor of any scale are positive."""
    (a, d, e), (_, b, f), (_, _, c) = scaled_together(tensor)[0]
    # Gaussian elimination, with the multipliers of the first row and the second one.
    first = jnp.where(a > 0, a, 1.0)
    b = b - d * (d / first)
    c = c - e * (e / first)
    f = f - d * (e / first)
    second = jnp.where(b > 0, b, 1.0)
    return (a > 0) & (b > 0) & (c - f * (f / second) > 0)


def is_inertia(inertia: Array) -> Bool[Array, ""]:
    """True where moments or a tensor are finite, symmetric and positive definite."""
    inertia = jax.lax.stop_gradient(inertia)
    if inertia.ndim == 1:
        return all_positive(inertia)
    return all_finite(inertia) & is_symmetric(inertia) & is_positive_definite(inertia)


def harmless(ok: Array, tree: Tree) -> Tree:
    """Replace the arrays of an invalid lane by ones, and tensors by unit tensors.

    Derivatives of NaN are NaN, even those that a mask multiplies by zero. With its own
    values an invalid lane would make NaN of the derivatives of what lanes share.
    """

    def replaced(x: PyTree) -> PyTree:
        if not eqx.is_inexact_array(x):
            return x
        # A tensor of ones would be singular.
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
    """The values of a formula where `ok`, else NaN, without NaN in derivatives."""
    return nan_where(~ok, formula(*harmless(ok, arguments)))


class _Diagnosis(NamedTuple):
    """The first condition that fails, and the reports of all conditions.

    Attributes:
        first: Index of that condition in the other two.
        messages: Error messages.
        values: Shown after the messages; None for no value.
    """

    first: Array
    messages: tuple[str, ...]
    values: tuple[Any, ...]


class Findings:
    """Collects errors in the inputs of one call; the first one is reported."""

    def __init__(self) -> None:
        """Start without errors."""
        self.ok: Any = np.True_
        self.result: Any = RESULTS.successful
        self._failed: list[AnyBool] = []
        self._messages: list[str] = []
        self._values: list[Any] = []

    def require(
        self, ok: AnyBool, code: Any, message: str | None = None, value: Any = None
    ) -> None:
        """Note an error where `ok` is False.

        Args:
            ok: Whether the condition holds.
            code: The result code, or None in a builder, which keeps no code.
            message: The sentence to report; by default that of the code.
            value: The value to show after it.
        """
        # Only the first error of a lane sets its code.
        failed = self.ok & ~ok
        if code is not None:
            if not isinstance(failed, np.bool_):
                self.result = RESULTS.where(failed, code, self.result)
            elif failed:
                # Known on the host, so that no program is compiled.
                self.result = code
        self.ok = self.ok & ok
        self._failed.append(~ok)
        self._messages.append(str(RESULTS[code] if message is None else message))
        self._values.append(value)

    def compute_once(self) -> None:
        """Reduce the conditions to one value, which all later kernels read.

        XLA's CPU compiler would compute a chain of conditions anew in each kernel that
        depends on it. It does not repeat a square root.
        """
        self.ok = jnp.sqrt(jnp.where(self.ok, np.float32(1), np.float32(0))) > 0

    def guard(self, tree: Tree, throw: bool) -> Tree:
        """Return the result of a builder; raise, or return NaN, for invalid input."""
        check_known("throw", throw)
        if not throw:
            return nan_where(~self.ok, tree)
        return _refuse(tree, ~self.ok, self.diagnosis)

    def diagnosis(self) -> _Diagnosis:
        """Find the first condition that fails; there must be at least one condition."""
        first = _first_failed(self._failed)
        return _Diagnosis(first, tuple(self._messages), tuple(self._values))

    def diagnosis_of(self, result: RESULTS) -> _Diagnosis:
        """Find the first that fails, or the text of the result code if none fails."""
        code = code_of(result)
        first = jnp.where(
            self.ok, len(self._failed) + code, _first_failed(self._failed)
        )
        # The messages of the result codes follow those of the conditions.
        messages = (*self._messages, *RESULTS.texts)
        values = (*self._values, *[None] * len(RESULTS.texts))
        return _Diagnosis(first, messages, values)


@jax.jit
def _first_failed(failed: list[AnyBool]) -> Array:
    """The index of the first True; 0 if there is none."""
    first = jnp.argmax(jax.lax.stop_gradient(jnp.stack(failed)))
    # The dtype of result codes.
    return first.astype(jnp.int32)


def is_without_error(result: Any) -> AnyBool:
    """Whether a result code reports no error."""
    return (result == RESULTS.successful) | (result == RESULTS.event_occurred)


def settle(
    answer: Tree,
    throw: bool,
    findings: Callable[..., Findings],
    *arguments: Any,
) -> Tree:
    """Return the answer of a solver or an estimator, or raise if it failed and `throw`.

    A compiled program of its own finds the error, and the next failing call uses this
    program again. So `findings` must be a function of the module, and all else must be
    in the arguments. A closure would be compiled, and stay in memory, for each error.

    Args:
        answer: An object with a `result` of `RESULTS`.
        throw: Whether to raise.
        findings: Checks the arguments again, to find which of them is wrong.
        arguments: Passed to `findings`: pytrees of arrays and of hashable
            configuration.
    """
    check_known("throw", throw)
    if not throw:
        return answer
    result: Any = answer.result  # pyright: ignore[reportAttributeAccessIssue]
    good = is_without_error(result)
    return _refuse(
        answer, ~good, lambda: _diagnosis(findings, ~good, result, *arguments)
    )


@quick_jit
def _diagnosis(
    findings: Callable[..., Findings], bad: Array, result: RESULTS, *arguments: Any
) -> _Diagnosis:
    """The diagnosis of a failed call, from its findings and its result code."""
    diagnosis = findings(*arguments).diagnosis_of(result)
    # equinox raises the message of the largest index in a batch, which must not be that
    # of a valid lane.
    first = jnp.where(bad, diagnosis.first, 0)
    values = jax.lax.stop_gradient(jtu.tree_map(jnp.asarray, diagnosis.values))
    return _Diagnosis(first, diagnosis.messages, values)


def _refuse(tree: Tree, bad: AnyBool, diagnose: Callable[[], _Diagnosis]) -> Tree:
    """Return the tree, or raise an error where `bad`.

    The error is raised in Python if `bad` is known, also under vmap and grad.
    """
    # Under vmap `bad` is a tracer, even where the values of all lanes are known.
    some = unvmap_any(bad)
    if isinstance(some, jax.core.Tracer):
        diagnosis = diagnose()
        # Of several bad lanes the last message is raised.
        return eqx.branched_error_if(
            tree, bad, diagnosis.first, list(diagnosis.messages)
        )
    if some:
        raise RuntimeError(_message(bad, diagnose()))
    return tree


def _message(bad: AnyBool, diagnosis: _Diagnosis) -> str:
    """The error message for the first bad lane, with the value and the lane."""
    is_bad, firsts = _all_lanes(bad, diagnosis.first)
    # Without vmap the lane is the empty tuple.
    lane = tuple(np.argwhere(is_bad)[0].tolist())
    first = int(firsts[lane])
    details = []
    if diagnosis.values[first] is not None:
        value = jax.lax.stop_gradient(jnp.asarray(diagnosis.values[first]))
        details.append(str(_all_lanes(bad, value)[1][lane]))
    if lane:
        others = f" and {is_bad.sum() - 1} more" if is_bad.sum() > 1 else ""
        details.append(f"in lane {lane[0] if len(lane) == 1 else lane}{others}")
    # A hint in brackets follows the value.
    sentence, stop, hint = diagnosis.messages[first].partition(". (")
    shown = f": {' '.join(details)}" if details else ""
    return sentence.rstrip(".") + shown + (stop or ".") + hint


def _all_lanes(*values: Any) -> list[np.ndarray]:
    """Known values of all lanes of the vmaps around the call, with lanes in front."""
    if not any(isinstance(x, jax.core.Tracer) for x in values):
        return [np.asarray(x) for x in values]
    arrays: list[np.ndarray] = []

    # A tracer of vmap hides its values, but the rule of `custom_vmap` receives them.
    @jax.custom_batching.custom_vmap
    def look(*values: Any) -> Any:
        return values[0]

    @look.def_vmap
    def _(size: int, batched: list[bool], *values: Any) -> tuple[Any, bool]:
        spread = [
            x if has else jnp.broadcast_to(x, (size, *x.shape))
            for x, has in zip(values, batched, strict=True)
        ]
        # Under nested vmaps these values are tracers of the outer one.
        arrays.extend(_all_lanes(*spread))
        return values[0], batched[0]

    look(*values)
    return arrays
