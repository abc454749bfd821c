"""Sweeps: blocks, stores, executors, refined maps, and what may go wrong on the way."""

import dataclasses
import importlib
import json
import multiprocessing
import os
import subprocess
import sys
import threading
import warnings
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sweep_job
from helpers import in_a_process

import jrigid as jr

xarray = pytest.importorskip("xarray")
zarr = pytest.importorskip("zarr")
JOB = Path(sweep_job.__file__)
ORDER = jr.stability.ORDER
AXES = {"a": np.linspace(0, 1, 5), "b": np.arange(7), "c": np.linspace(-1, 2, 3)}


def tree(a, b, c):
    order = ORDER.where(a > b, ORDER.chaotic, ORDER.regular)
    return {
        "product": a * b + c,
        "vector": jnp.stack([a, b, c]),
        "order": ORDER.where(c > 1, ORDER.undefined, order),
    }


def quiet(function, *args, **kwargs):
    return jr.sweep(function, *args, progress=False, **kwargs)


def expected():
    return np.meshgrid(*AXES.values(), indexing="ij")


# Blocks


@pytest.mark.parametrize("size", [1, 4, 35, 1000, None])
def test_a_sweep_is_the_function_at_each_point_whatever_the_blocks(size):
    a, b, c = expected()
    found = quiet(tree, AXES, block_size=size)
    np.testing.assert_array_equal(found.values["vector"], np.stack([a, b, c], axis=-1))
    np.testing.assert_allclose(found.values["product"], a * b + c)
    np.testing.assert_array_equal(found.valid, c <= 1)
    np.testing.assert_array_equal(
        found.values["order"] == ORDER.chaotic, (a > b) & (c <= 1)
    )
    assert found.labels == ("a", "b", "c")
    assert found.failures == ()


def test_points_may_be_a_list_of_any_tree():
    states = jr.State(
        np.tile([1.0, 0, 0, 0], (11, 1)), np.linspace(0.1, 3, 33).reshape(11, 3), None
    )

    def energy(point):
        state, scale = point
        return scale * jr.kinetic_energy(jnp.array([1.0, 2, 3]), state.omega)

    found = quiet(energy, points=(states, np.arange(1.0, 12.0)), block_size=4)
    wanted = (
        0.5
        * np.sum(np.asarray(states.omega) ** 2 * [1, 2, 3], axis=1)
        * np.arange(1, 12)
    )
    np.testing.assert_allclose(found.values, wanted, rtol=1e-14)
    assert found.labels == ("point",)


@pytest.mark.parametrize("kind", [">f8", ">f4", ">i4"])
def test_numbers_of_another_byte_order_are_as_those_of_this_machine(kind, tmp_path):
    x = np.arange(9)
    function = lambda x: 2.0 * x  # noqa: E731
    for more in ({}, {"store": tmp_path / "s"}):
        swept = quiet(function, {"x": x.astype(kind)}, **more)
        np.testing.assert_array_equal(swept.values[...], 2 * x)
        assert swept.axes["x"].dtype.isnative
    as_float = lambda x: 2.0 * x.astype(float)  # noqa: E731
    assert np.all(quiet(as_float, points=x.astype(kind)).values == 2 * x)


def test_valid_is_a_numpy_array_with_a_store_and_without(tmp_path):
    for more in ({}, {"store": tmp_path / "s"}):
        assert type(quiet(tree, AXES, **more).valid) is np.ndarray


def test_a_second_sweep_of_the_same_function_traces_nothing():
    traces = []

    def counted(x):
        traces.append(1)
        return x**2

    quiet(counted, {"x": np.linspace(0, 1, 9)}, block_size=4)
    first = len(traces)
    for _ in range(2):
        quiet(counted, {"x": np.linspace(0, 2, 9)}, block_size=4)
    assert len(traces) == first


def test_a_sweep_keeps_the_settings_that_are_around_it(pool):
    noise = lambda x: x + jax.random.normal(jax.random.key(3))  # noqa: E731
    with jax.default_prng_impl("rbg"):
        wanted = noise(jnp.array(1.0))
        for more in ({}, {"executor": pool}):
            assert quiet(noise, points=np.ones(2), **more).values[0] == wanted
    with jax.enable_x64(False):
        found = quiet(lambda x: x / 3, {"x": np.linspace(0, 1, 9)}, block_size=4)
    assert found.values.dtype == np.float32
    assert quiet(lambda x: x / 3, {"x": np.ones(2)}).values.dtype == np.float64


# Stores


def test_a_store_opens_in_xarray_with_names_units_and_meanings(tmp_path):
    about = {"a": {"units": "rad/s"}, "product": {"long_name": "a product"}}
    found = quiet(tree, AXES, store=tmp_path / "s", block_size=10, attributes=about)
    a, b, c = expected()
    np.testing.assert_array_equal(found.values["product"][...], a * b + c)
    for dataset in (xarray.open_zarr(tmp_path / "s"), found.to_xarray()):
        assert dataset["product"].dims == ("a", "b", "c")
        assert dataset["vector"].dims == ("a", "b", "c", "vector_0")
        assert dataset["a"].attrs["units"] == "rad/s"
        assert dataset["product"].attrs["long_name"] == "a product"
        assert dataset["order"].attrs["flag_meanings"].split()[0] == "regular"
        made_by = json.loads(dataset.attrs["jrigid"])["versions"]
        assert made_by["jax"] == jax.__version__
        np.testing.assert_array_equal(dataset["valid"], c <= 1)
        np.testing.assert_array_equal(dataset["product"].sel(b=3.0), (a * b + c)[:, 3])
    memory = quiet(tree, AXES, attributes=about).to_xarray()
    xarray.testing.assert_equal(dataset.load(), memory)
    assert memory["a"].attrs == {"units": "rad/s"}


def test_a_store_keeps_its_attributes_and_takes_more(tmp_path):
    store = tmp_path / "s"
    first = {"a": {"units": "rad/s"}, "product": {"units": "J"}}
    quiet(tree, AXES, store=store, attributes=first)
    assert quiet(tree, AXES, store=store).attributes == first
    more = {"product": {"units": "mJ"}, "order": {"long_name": "kind"}}
    assert quiet(tree, AXES, store=store, attributes=more).attributes == first | more
    dataset = xarray.open_zarr(store)
    assert dataset["a"].units == "rad/s"
    assert dataset["product"].units == "mJ"
    assert dataset["order"].long_name == "kind"
    assert dataset["order"].flag_meanings.split()[0] == "regular"


def test_a_store_that_is_half_finished_opens_and_plots(tmp_path):
    plt = pytest.importorskip("matplotlib.pyplot")
    axes = {"x": np.linspace(0, 1, 8), "y": np.linspace(0, 2, 4)}
    quiet(
        lambda x, y: {"sum": x + y, "n": jnp.int32(3)},
        axes,
        store=tmp_path / "s",
        block_size=8,
    )
    for block in (1, 2):
        for name in ("valid", "sum", "n"):
            (tmp_path / "s" / name / "c" / str(block) / "0").unlink()
    dataset = xarray.open_zarr(tmp_path / "s")
    known = np.isin(np.arange(8) // 2, (0, 3))
    np.testing.assert_array_equal(
        np.isfinite(dataset["sum"]), known[:, None] & np.ones(4, bool)
    )
    np.testing.assert_array_equal(
        np.isfinite(dataset["n"]), np.isfinite(dataset["sum"])
    )
    dataset["sum"].plot()
    plt.close("all")


def chunks(store):
    """What every chunk is, and when it was written."""
    found = {}
    for file in Path(store).rglob("c/**/*"):
        if file.suffix != ".partial" and file.is_file():
            found[file] = file.stat().st_ino, file.stat().st_mtime_ns
    return found


def test_what_is_done_is_not_done_again_and_what_is_spoilt_is(tmp_path):
    store = tmp_path / "s"
    quiet(tree, AXES, store=store, block_size=10)
    whole, before = sweep_job.contents(store), chunks(store)
    quiet(tree, AXES, store=store)  # in the blocks that it has
    assert chunks(store) == before
    names = sorted(x for x in before if "vector" in str(x) or "product" in str(x))
    short, flipped, lost = names[0], names[3], names[-1]
    short.write_bytes(short.read_bytes()[:-9])
    damaged = bytearray(flipped.read_bytes())
    damaged[5] ^= 1
    flipped.write_bytes(damaged)
    lost.unlink()
    (lost.parent / "0.abc.partial").write_bytes(b"half")
    quiet(tree, AXES, store=store)
    assert sweep_job.contents(store) == whole
    places = {x.parts[x.parts.index("c") :][:4] for x in (short, flipped, lost)}
    again = {x for x, when in chunks(store).items() if before[x] != when}
    assert {x.parts[x.parts.index("c") :][:4] for x in again} == places


def test_a_store_of_another_sweep_is_refused_with_what_differs(tmp_path):
    store, axes = tmp_path / "s", {"x": np.linspace(0, 1, 9)}
    factor = jnp.array(2.0)
    quiet(lambda x: factor * x, axes, store=store, block_size=4)
    before = chunks(store)
    doubled = jnp.array(2.0)
    quiet(lambda x: doubled * x, axes, store=store)  # the same function in other words
    assert chunks(store) == before
    three = jnp.array(3.0)
    for function, other, size, named in [
        (lambda x: three * x, axes, None, "function"),
        (lambda x: jnp.stack([x, x]), axes, None, "function"),
        (lambda x: factor * x, {"x": axes["x"] + 1e-12}, None, "points"),
        (lambda x: factor * x, {"x": axes["x"][1:]}, None, "shape"),
        (lambda x: factor * x, axes, 2, "block"),
        (lambda x: {"other": factor * x}, axes, None, "values"),
    ]:
        with pytest.raises(ValueError, match=rf"of another: .*{named} \("):
            quiet(function, other, store=store, block_size=size)
    with jax.enable_x64(False), pytest.raises(ValueError, match="of another"):
        quiet(lambda x: factor * x, axes, store=store)
    described = json.loads((store / "zarr.json").read_text())
    about = json.loads(described["attributes"]["jrigid"])
    about["versions"]["jaxlib"] = "0.1"
    described["attributes"]["jrigid"] = json.dumps(about)
    (store / "zarr.json").write_text(json.dumps(described))
    with pytest.raises(ValueError, match=r"versions \(.*0\.1"):
        quiet(lambda x: factor * x, axes, store=store)
    assert chunks(store) == before
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "zarr.json").write_text("{}")
    for path in (tmp_path / "mine", store / "zarr.json"):
        with pytest.raises(ValueError, match="must be a new directory"):
            quiet(lambda x: x, axes, store=path)


def test_a_fingerprint_is_that_of_the_traced_function(tmp_path):
    """Of a motion with all that it calls, in two processes."""
    script = (
        "import sys; sys.argv = ['', 'here']\n"
        "import jax; jax.config.update('jax_enable_x64', True)\n"
        "import jax.numpy as jnp, numpy as np, equinox as eqx, jrigid as jr\n"
        "from jrigid.sweep._work import traced\n"
        "class Point(eqx.Module):\n"
        "    moments: jax.Array\n"
        "    def __call__(self, x):\n"
        "        body = jr.RigidBody(self.moments, jr.torques.LinearDrag(x))\n"
        "        q = jnp.array([1.0, 0, 0, 0])\n"
        "        state = jr.State(q, jnp.stack([x, x, 1]))\n"
        "        return jr.simulate(body, state, 1.0, throw=False).states.omega\n"
        "point = Point(jnp.array([1.0, 2, 3]))\n"
        "print(traced(point, ('x',), (np.linspace(0.1, 1, 3),))[1]['function'])\n"
    )
    first = in_a_process(script, PYTHONHASHSEED="1")[0]
    assert first == in_a_process(script, PYTHONHASHSEED="2")[0]
    assert first != in_a_process(script.replace("[1.0, 2, 3]", "[1.0, 2, 3.5]"))[0]
    assert first != in_a_process(script.replace("state, 1.0", "state, 1.5"))[0]


def test_a_store_has_one_writer(tmp_path):
    inside, leave = threading.Event(), threading.Event()

    class Waits(ThreadPoolExecutor):
        def submit(self, *args, **kwargs):
            inside.set()
            leave.wait(20)
            return super().submit(*args, **kwargs)

    axes = {"x": np.linspace(0, 1, 9)}
    function = lambda x: x**2  # noqa: E731
    with Waits(1) as pool, ThreadPoolExecutor(1) as other:
        first = other.submit(quiet, function, axes, store=tmp_path / "s", executor=pool)
        inside.wait(20)
        with pytest.raises(RuntimeError, match="Another process is writing"):
            quiet(function, axes, store=tmp_path / "s")
        leave.set()
        assert first.result().valid[...].all()


SQUARE = {"x": np.linspace(0, 1, 40), "y": np.linspace(0, 1, 100)}


def square(x, y):
    return x**2 + y


def limited(script, tmp_path, before=""):
    """What a sweep says in a process that may not write what it wants."""
    text = (
        "import os, resource, signal, sys, jax, numpy as np, jrigid as jr\n"
        "jax.config.update('jax_enable_x64', True)\n"
        "axes = {'x': np.linspace(0, 1, 40), 'y': np.linspace(0, 1, 100)}\n"
        "run = lambda path: jr.sweep(lambda x, y: x**2 + y, axes, store=path, "
        "block_size=1000, progress=False)\n"
        f"run({str(tmp_path / 'warm')!r})\n"
        f"{before}\n"
        "try:\n"
        f"    {script}\n"
        "except OSError as error:\n"
        "    print(type(error).__name__, error)\n"
    )
    return in_a_process(text)[0]


def test_a_full_disk_is_said_and_loses_nothing(tmp_path):
    store = tmp_path / "s"
    full = "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
    full += "resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))"
    said = limited(f"run({str(store)!r})", tmp_path, full)
    assert "cannot be written" in said
    assert "File too large" in said
    assert "goes on from there" in said
    assert not list(store.rglob("valid/c/*"))
    quiet(square, SQUARE, store=store)
    assert sweep_job.contents(store) == sweep_job.contents(tmp_path / "warm")


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="permissions of Unix")
def test_a_directory_that_is_read_only_is_said(tmp_path):
    store = tmp_path / "s"
    quiet(square, SQUARE, store=store, block_size=1000)
    whole = sweep_job.contents(store)
    (store / "valid" / "c" / "2" / "0").unlink()
    closed = [store, *(x for x in store.rglob("*") if x.is_dir()), tmp_path]
    for path in closed:
        path.chmod(0o555)
    lower = "os.geteuid() or os.seteuid(65534)"
    said = limited(f"run({str(store)!r})", tmp_path.parent, lower)
    assert "cannot be written" in said or "PermissionError" in said
    said = limited(f"run({str(tmp_path / 'new')!r})", tmp_path.parent, lower)
    assert "Permission" in said
    for path in closed:
        path.chmod(0o755)
    quiet(square, SQUARE, store=store)
    assert sweep_job.contents(store) == whole


# Executors


def job(mode, store, blocks):
    path = str(Path(jr.__file__).parents[1])
    environment = os.environ | {"PYTHONPATH": path, "TF_CPP_MIN_LOG_LEVEL": "3"}
    return subprocess.run(
        [sys.executable, JOB, mode, store, str(blocks)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_same_store_bit_for_bit_wherever_it_was_computed(tmp_path):
    """One process, two devices, a pool of two that spawns, a cluster of two."""
    found = {}
    for mode in ("here", "devices", "pool", "dask"):
        done = job(mode, tmp_path / mode, 7)
        assert done.returncode == 0, done.stderr
        count, found[mode] = done.stdout.split()
        assert count == ("2" if mode == "devices" else "1")
    assert len(set(found.values())) == 1


@pytest.fixture(scope="module")
def pool():
    with ProcessPoolExecutor(
        1, mp_context=multiprocessing.get_context("spawn")
    ) as executor:
        yield executor


def test_lambdas_and_trees_go_to_other_processes_and_back(pool):
    a, b, c = expected()
    factor = jnp.array(2.0)
    found = quiet(
        lambda a, b, c: factor * a + b * c, AXES, executor=pool, block_size=10
    )
    np.testing.assert_array_equal(found.values, 2 * a + b * c)
    assert quiet(tree, AXES, executor=pool).values["vector"].shape == (5, 7, 3, 3)
    lock = threading.Lock()
    with pytest.raises(ValueError, match="other processes can be sent, but"):
        quiet(lambda x: (lock, x)[1], {"x": np.ones(3)}, executor=pool)


def test_a_block_that_fails_is_tried_thrice_recorded_and_the_others_go_on(
    pool, tmp_path
):
    def picky(x, y):
        return eqx.error_if(x + y, (x == 2) & (y == 3), "not this one")

    axes = {"x": np.arange(4.0), "y": np.arange(6.0)}
    for more in ({}, {"executor": pool}, {"store": tmp_path / "s"}):
        with pytest.warns(
            UserWarning, match=r"1 of 8 blocks failed three times.*not this one"
        ):
            found = quiet(picky, axes, block_size=3, **more)
        (failure,) = found.failures
        assert failure.first == (2, 3)
        assert failure.last == (2, 5)
        assert "not this one" in failure.error
        assert np.sum(~found.valid[...]) == 3
        assert np.isnan(found.values[...][2, 3:]).all()
    about = json.loads(found.to_xarray().attrs["jrigid"])
    assert "not this one" in about["failures"][0]["error"]
    description = tmp_path / "s" / "zarr.json"
    before = description.stat()
    half = tmp_path / "s" / "zarr.partial"
    half.write_text("half")  # of a process that was killed
    with pytest.warns(UserWarning, match="failed three times"):
        quiet(picky, axes, store=tmp_path / "s")  # what failed is tried again
    # The same blocks failed, so that the description stays as it is.
    assert description.stat().st_ino == before.st_ino
    assert description.stat().st_mtime_ns == before.st_mtime_ns
    assert not half.exists()


def test_a_worker_that_dies_or_lacks_jrigid_is_said():
    spawn = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(1, mp_context=spawn, initializer=die)
    with executor, pytest.raises(RuntimeError, match="worker of the executor died"):
        quiet(jnp.sin, points=np.ones(3), executor=executor)
    executor = ProcessPoolExecutor(1, mp_context=spawn, initializer=without_jrigid)
    with executor, pytest.raises(ImportError, match="Workers need jrigid"):
        quiet(jnp.sin, points=np.ones(3), executor=executor)
    forks = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork"))
    with pytest.raises(ValueError, match="must not fork"):
        quiet(jnp.sin, points=np.ones(3), executor=forks)


def test_a_worker_of_dask_that_lacks_jrigid_is_said():
    script = (
        "import sys, jax.numpy as jnp, jrigid as jr\n"
        "from dask.distributed import Client, LocalCluster\n"
        "if __name__ == '__main__':\n"
        "    cluster = LocalCluster(n_workers=1, threads_per_worker=1, "
        "dashboard_address=None)\n"
        "    client = Client(cluster)\n"
        "    client.run(lambda: sys.modules.__setitem__('jrigid', None))\n"
        "    try:\n"
        "        jr.sweep(jnp.sin, points=jnp.ones(3), "
        "executor=client.get_executor())\n"
        "    except ImportError as error:\n"
        "        print('said:', error)\n"
    )
    assert "Workers need jrigid" in in_a_process(script)[0]


def test_a_worker_with_an_older_module_is_refused(tmp_path, monkeypatch):
    module = tmp_path / "edited.py"
    module.write_text("def scaled(x):\n    return 1.0 * x\n")
    monkeypatch.syspath_prepend(tmp_path)
    import edited  # pyright: ignore

    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        1, mp_context=spawn, initializer=sys.path.append, initargs=(str(tmp_path),)
    ) as executor:
        one = quiet(edited.scaled, points=np.ones(3), executor=executor)
        assert np.all(one.values == 1)
        module.write_text("def scaled(x):\n    return 5.0 * x + 0.0\n")
        importlib.reload(edited)
        with pytest.raises(RuntimeError, match="start it anew"):
            quiet(
                edited.scaled,
                points=np.ones(3),
                executor=executor,
                store=tmp_path / "s",
            )


def die():
    os._exit(1)


def without_jrigid():
    sys.modules["jrigid"] = None


class Lazy(ThreadPoolExecutor):
    """Fails now and then as a cluster does."""

    def __init__(self, error):
        super().__init__(1)
        self.error, self.count = error, 0

    def submit(self, *args, **kwargs):
        self.count += 1
        if self.count % 3 == 1:
            return super().submit(self.fail)
        return super().submit(*args, **kwargs)

    def fail(self):
        raise self.error


def test_what_an_executor_loses_is_sent_again():
    with Lazy(OSError("the worker went away")) as executor:
        found = quiet(
            jnp.sin, points=np.linspace(0, 1, 40), executor=executor, block_size=10
        )
    assert found.valid.all()
    bare = Lazy(ModuleNotFoundError("No module named 'jrigid'"))
    with bare as executor, pytest.raises(ImportError, match="Workers need jrigid"):
        quiet(jnp.sin, points=np.linspace(0, 1, 40), executor=executor)


def test_an_interrupt_leaves_a_store_that_goes_on(tmp_path):
    store, axes = tmp_path / "s", {"x": np.linspace(0, 1, 40)}

    class Interrupted(ThreadPoolExecutor):
        count = 0

        def submit(self, *args, **kwargs):
            self.count += 1
            if self.count == 6:
                raise KeyboardInterrupt
            return super().submit(*args, **kwargs)

    function = lambda x: jnp.sin(x)  # noqa: E731
    with Interrupted(1) as executor, pytest.raises(KeyboardInterrupt):
        quiet(function, axes, store=store, block_size=4, executor=executor)
    before = chunks(store)
    found = quiet(function, axes, store=store)
    assert found.valid[...].all()
    assert before.items() <= chunks(store).items()


# Refined maps


def test_a_refined_map_finds_the_boundary_at_a_part_of_the_points(tmp_path):
    axes = {"x": np.linspace(-1, 1, 700), "y": np.linspace(-1, 1, 500)}

    def function(x, y):
        return {"value": (x**2 + y**2 - 0.5) * (1.2 + jnp.sin(9 * x)), "x": x}

    whole = quiet(function, axes)
    inside = lambda values: values["value"] > 0  # noqa: E731
    found = quiet(function, axes, refine=inside, block_size=256)
    kept = quiet(function, axes, refine=inside, block_size=256, store=tmp_path / "s")
    for refined in (found, kept):
        np.testing.assert_array_equal(refined.classes, whole.values["value"] > 0)
        known = refined.valid[...]
        assert 0.02 < known.mean() < 0.12
        np.testing.assert_allclose(
            refined.values["value"][...][known],
            whole.values["value"][known],
            atol=1e-14,
        )
        assert np.isnan(refined.values["value"][...][~known]).all()
        np.testing.assert_array_equal(refined.to_xarray()["classes"], found.classes)
    before = chunks(tmp_path / "s")
    again = quiet(function, axes, refine=inside, store=tmp_path / "s")
    assert chunks(tmp_path / "s") == before
    np.testing.assert_array_equal(again.classes, found.classes)


def test_integers_not_computed_are_nan_in_xarray_and_all_goes_to_netcdf(tmp_path):
    axes = {"x": np.linspace(-1, 1, 24), "y": np.linspace(-1, 1, 24)}
    number = lambda x, y: {"sum": x + y, "n": jnp.int32(3)}  # noqa: E731
    about = {"sum": {"units": "s"}}
    for more in ({}, {"store": tmp_path / "s"}):
        refine = lambda values: values["sum"] > 1.6  # noqa: E731
        found = quiet(
            number, axes, refine=refine, block_size=16, attributes=about, **more
        )
        found.to_xarray().to_netcdf(tmp_path / "map.nc")
        with xarray.open_dataset(tmp_path / "map.nc", decode_timedelta=False) as file:
            for dataset in (file, found.to_xarray()):
                known = dataset["valid"].values.astype(bool)
                assert 0 < known.mean() < 1
                np.testing.assert_array_equal(dataset["n"], np.where(known, 3, np.nan))
                assert dataset["sum"].dtype == float
                assert dataset["sum"].units == "s"


def test_a_boundary_that_no_corner_shows_is_followed_from_block_to_block():
    """A finger, thinner than a tile, that leaves a half-plane."""
    axes = {"x": np.arange(200.0), "y": np.arange(160.0)}

    def finger(x, y):
        return jnp.where((y < 40) | ((abs(x - 56.0) < 3) & (y < 133)), 1.0, -1.0)

    found = quiet(finger, axes, refine=lambda value: value > 0, block_size=256)
    np.testing.assert_array_equal(found.classes, quiet(finger, axes).values > 0)


def test_a_refined_map_beside_failures_nan_and_stores_in_rows(tmp_path):
    axes = {"x": np.linspace(-1, 1, 97), "y": np.linspace(-1, 1, 90)}
    disk = lambda x, y: x**2 + y**2 - 0.3  # noqa: E731
    inside = lambda value: value > 0  # noqa: E731
    wanted = quiet(disk, axes).values > 0

    def bad_corner(x, y):
        return eqx.error_if(disk(x, y), (x == -1) & (y == -1), "not this one")

    with pytest.warns(UserWarning, match="failed three times"):
        found = quiet(bad_corner, axes, refine=inside, block_size=64)
    (failure,) = found.failures
    assert failure.first == (0, 0)
    np.testing.assert_array_equal(found.classes[8:], wanted[8:])
    quiet(disk, axes, store=tmp_path / "tiles", refine=inside, block_size=64)
    quiet(disk, axes, store=tmp_path / "tiles")
    found = quiet(disk, axes, store=tmp_path / "tiles", refine=inside)
    assert found.valid[...].all()
    np.testing.assert_array_equal(found.classes, wanted)
    quiet(disk, axes, store=tmp_path / "rows")
    with pytest.raises(ValueError, match="store in tiles"):
        quiet(disk, axes, store=tmp_path / "rows", refine=inside)

    def partly(x, y):
        return {
            "v": jnp.where(x + y > 0.9, jnp.nan, 1.0),
            "k": jnp.where(disk(x, y) > 0, 1, 0),
        }

    found = quiet(partly, axes, refine=lambda values: values["k"], block_size=64)
    np.testing.assert_array_equal(found.classes, wanted)


def test_codes_and_numbers_are_classes_and_others_are_refused():
    axes = {"x": np.linspace(-1, 1, 40), "y": np.linspace(-1, 1, 50)}
    code = lambda x, y: ORDER.where(x > y, ORDER.chaotic, ORDER.regular)  # noqa: E731
    found = quiet(code, axes, refine=lambda value: value, block_size=16)
    np.testing.assert_array_equal(found.classes == 2, axes["x"][:, None] > axes["y"])
    assert found.class_names == ("regular", "undecided", "chaotic", "undefined")
    assert found.to_xarray()["classes"].flag_meanings.split()[2] == "chaotic"
    with pytest.raises(ValueError, match="`refine` must return one"):
        quiet(lambda x, y: x - y, axes, refine=lambda value: value)
    with pytest.raises(ValueError, match=r"Use `jax.numpy` in `refine`, not .*`int`"):
        quiet(lambda x, y: x - y, axes, refine=lambda value: int(value > 0))
    with pytest.raises(ValueError, match=r"`jnp.where` .* in the function of a sweep"):
        quiet(lambda x, y: x if y > 0 else y, axes)
    with pytest.raises(ValueError, match="`refine` is for a grid"):
        quiet(jnp.sin, points=np.ones(3), refine=lambda value: value > 0)


# What may be wrong


def test_arguments_that_are_wrong_are_named():
    axes = {"x": np.linspace(0, 1, 5)}
    with pytest.raises(ValueError, match="one of the arguments `axes` and `points`"):
        quiet(jnp.sin)
    with pytest.raises(ValueError, match="one of the arguments"):
        quiet(jnp.sin, axes, points=np.ones(3))
    with pytest.raises(ValueError, match="same number of points in front"):
        quiet(lambda p: p[0], points=(np.ones(3), np.ones(4)))
    with pytest.raises(ValueError, match="same number of points in front"):
        quiet(jnp.sin, points=1.0)
    records = np.zeros(3, [("mass", float)])
    for points in (dataclasses.make_dataclass("P", ["a"])(np.ones(3)), records):
        with pytest.raises(
            ValueError, match="must hold arrays of numbers, but it hold"
        ):
            quiet(lambda p: p.a, points=points)
    with pytest.raises(ValueError, match="`points` must hold a point, but it is empty"):
        quiet(jnp.sum, points=np.zeros((0, 3)))
    large = np.array([2**53, 2**53 + 1])
    with pytest.raises(ValueError, match="the integers of 'x' are none: pass them by"):
        jr.sweep(lambda x: 1.0 * x, {"x": large}, progress=False)
    with pytest.raises(ValueError, match="`axes` must hold points, but 'x' is empty"):
        quiet(jnp.sin, {"x": np.zeros(0)})
    with pytest.raises(ValueError, match="must name at least one"):
        quiet(lambda: 1.0, {})
    with pytest.raises(ValueError, match="could say so"):
        quiet(lambda x: x > 0, axes)
    with pytest.raises(ValueError, match="could say so"):
        quiet(lambda x: {"none": None, "at": x > 0}["none"], axes)
    with pytest.raises(ValueError, match=r"name axes or values, but \['z'\]"):
        quiet(lambda x: x, axes, attributes={"z": {}})
    with pytest.raises(ValueError, match="block_size"):
        quiet(lambda x: x, axes, block_size=0)
    with pytest.raises(ValueError, match="must return arrays, but it returns 'x'"):
        quiet(lambda x: ("x", x), axes)
    with pytest.raises(ValueError, match="extent"):
        _ = quiet(lambda x: x, axes).extent


def test_arguments_of_another_type_are_named(untyped):
    axes = {"x": np.linspace(0, 1, 5)}
    with pytest.raises(ValueError, match=r"`attributes\['x'\]` must be a Mapping"):
        quiet(lambda x: x, axes, attributes={"x": "rad/s"})
    for wrong, kind in ((42, "a int"), (ThreadPoolExecutor, "the class")):
        with pytest.raises(ValueError, match=f"method `submit`, but it is {kind}"):
            quiet(lambda x: x, axes, executor=wrong)


def test_nothing_valid_is_said():
    with pytest.warns(UserWarning, match="None of the 5 points is valid"):
        quiet(lambda x: x * jnp.nan, {"x": np.linspace(0, 1, 5)})


def test_names_of_values_are_made_good(tmp_path):
    def named(x, v_0):
        odd = {"a/b": {"zarr.json": v_0}, "..": x, "partial": {"partial": x}}
        return {"valid": x, "x": 2 * x, "v": jnp.stack([x, v_0, x]), "odd": odd}

    axes = {"x": np.arange(3.0), "v_0": np.arange(4.0)}
    for more in ({}, {"store": tmp_path / "s"}, {"store": tmp_path / "s"}):
        found = quiet(named, axes, **more).to_xarray()
        assert set(found.data_vars) == {
            "valid",
            "valid_",
            "x_",
            "v_",
            "odd_a_b_zarr_json",
            "odd___",
            "odd_partial_partial",
        }
        np.testing.assert_array_equal(found["valid_"][:, 0], np.arange(3))
        np.testing.assert_array_equal(found["x_"][:, 0], 2 * np.arange(3))
    for name in ("valid", "a/b"):
        with pytest.raises(ValueError, match="must name arguments"):
            quiet(lambda **_: 1.0, {name: np.ones(3)})


def test_a_store_whose_description_is_spoilt_loses_nothing(tmp_path):
    store, axes = tmp_path / "s", {"x": np.linspace(0, 1, 9)}
    store.mkdir()
    function = lambda x: {"sine": jnp.sin(x)}  # noqa: E731
    quiet(function, axes, store=store, block_size=4)
    before, whole = chunks(store), sweep_job.contents(store)
    for file in (store / "sine" / "zarr.json", store / "valid" / "zarr.json"):
        kept = file.read_bytes()
        file.write_bytes(kept[:40])
        with pytest.raises(OSError, match="is damaged"):
            quiet(function, axes, store=store)
        file.write_bytes(kept)
    assert chunks(store) == before
    (store / "x" / "c" / "0").unlink()
    quiet(function, axes, store=store)
    assert sweep_job.contents(store) == whole


def test_progress_is_shown_with_and_without_a_bar(monkeypatch, capsys):
    axes = {"x": np.arange(4.0)}
    jr.sweep(lambda x: x, axes, block_size=2)
    assert "4.00/4.00" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "tqdm", None)
    jr.sweep(lambda x: x, axes, block_size=2)
    assert "4 of 4 points" in capsys.readouterr().err


def test_a_missing_extra_is_named(monkeypatch):
    found = quiet(lambda x: x, {"x": np.arange(4.0)})
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ImportError, match=r"jrigid\[sweep\]"):
        found.to_xarray()


def test_nothing_is_warned_of(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        quiet(tree, AXES, store=tmp_path / "s", block_size=10)
        xarray.open_zarr(tmp_path / "s").load()
