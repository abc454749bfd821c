"""What `help` shows: names of aliases, fields, codes with a text each."""

import inspect

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError

import jrigid as jr
from jrigid import _types

ALIASES = [
    name for name in vars(_types) if name.endswith("Like") and name != "ArrayLike"
]


def test_an_alias_is_shown_by_its_name():
    shown = str(inspect.signature(jr.free.wobble_rate))
    assert "inertia: InertiaLike, omega: VectorLike" in shown
    assert shown.endswith("-> Scalar")
    assert "InertiaLike" in ALIASES
    assert all(str(getattr(_types, name)) == name for name in ALIASES)
    assert "values: Optional[Real[ArrayLike, '*trials n k']]" in str(
        inspect.signature(jr.identify.Rates)
    )


@pytest.mark.parametrize("name", [x for x in dir(jr.identify) if not x.startswith("_")])
def test_no_signature_spells_a_union_of_arrays_out(name):
    public = getattr(jr.identify, name)
    if callable(public):
        assert "Union[" not in str(inspect.signature(public))


def test_aliases_are_still_checked_at_run_time():
    with pytest.raises(TypeCheckError, match="InertiaLike"):
        jr.free.wobble_rate(np.ones(4), np.ones(3))
    with pytest.raises(TypeCheckError, match="n 3"):
        jr.identify.weak_form(np.arange(9.0), np.ones((8, 3)))


def test_every_status_is_listed_with_a_text():
    status = jr.identify.Status
    names = [x for x in dir(status) if isinstance(getattr(status, x), status)]
    assert {"OK", "UNIDENTIFIABLE", "WRONG_BASIN", "BAD_INPUT"} <= set(names)
    assert all(status[getattr(status, name)] for name in names)
    assert sorted(status.texts) == sorted(
        status[getattr(status, name)] for name in names
    )


def test_observations_say_what_their_fields_are():
    for field in ("sensor: ", "ts: ", "values: ", "sigma: ", "covariance: ", "NaN"):
        assert field in jr.identify.Record.__doc__, field
    shown = repr(jr.identify.Rates(jnp.arange(2.0), np.ones((2, 3)), 0.1))
    assert shown.startswith("Record(sensor=Gyro(bias=[0., 0., 0.]")
    assert "ts=[0., 1.], values=[[1., 1., 1.]" in shown
