"""What is kept for the next start gives the same results, and nothing else is taken for it."""

import os
import signal
import threading
import time
from functools import partial
from pathlib import Path
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
import pytest
from bodies import PLAIN, two_gaussians
from kept_programs import made, planned, squares, total
from processes import run_together

import splatjax as sj

SCRIPT = Path(__file__).parent / "kept_programs.py"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch, jax_settings):
    """Keep in a folder of the test, and forget what others made."""
    made.clear()
    monkeypatch.setattr(sj.cache, "_folder", None)
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "jax"))
    return sj.cache.keep(tmp_path) / "kept"


def results_of_a_start():
    sj.cache._programs.clear()
    values = squares(jnp.arange(9.0))["squares"]
    return [*values.tolist(), float(total(values)["sum"])]


@pytest.mark.once
@pytest.mark.slow
def test_a_second_start_makes_the_same_picture_and_compiles_nothing(folder, compiled):
    light = sj.DirectionalLight([0, 0, -1.0], 3.0, cast_shadows=False)
    camera = sj.Camera.look_at([0, 0, 700.0], [0, 0, 0], width=8, height=8)
    frames = []
    for _ in range(2):
        sj.cache._programs.clear()
        compiled.clear()
        scene = sj.Scene(sj.bust(50), [light], sj.Material(two_gaussians()))
        frames.append(sj.render(scene, camera, PLAIN, sj.make_plan(scene, camera, PLAIN)))
    assert compiled == []
    assert eqx.tree_equal(*frames)
    names = sorted(path.name.partition("-")[0] for path in folder.iterdir())
    assert names == ["bust", "capacities", "make_plan", "render"]


DAMAGED = {
    "halved": lambda content, other: content[: len(content) // 2],
    "changed": lambda content, other: content[:-9] + bytes([content[-9] ^ 1]) + content[-8:],
    "emptied": lambda content, other: b"",
    "replaced": lambda content, other: other,
    "writable by others": lambda content, other: content,
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_a_damaged_or_foreign_file_is_replaced(damage, folder):
    expected, (one, other) = results_of_a_start(), folder.iterdir()
    for path, foreign in ((one, other), (other, one)):
        path.write_bytes(DAMAGED[damage](path.read_bytes(), foreign.read_bytes()))
        path.chmod(0o666 if "writable" in damage else 0o600)
        made.clear()
        assert results_of_a_start() == results_of_a_start() == expected
        assert made == [path.name.partition("-")[0]]  # once, and the other one not at all


def test_a_program_that_loads_but_does_not_run_is_compiled_again(monkeypatch):
    expected = results_of_a_start()
    fails = mock.Mock(side_effect=jax.errors.JaxRuntimeError("NOT_FOUND: a kernel"))
    monkeypatch.setattr(sj.cache, "deserialize_and_load", lambda *_: fails)
    assert results_of_a_start() == expected
    assert made == ["squares", "total", "total"]


def test_a_program_is_not_taken_out_of_the_cache_of_jax_to_be_kept(folder, events):
    """XLA would leave out some of its kernels; it is compiled instead."""
    for _ in range(2):
        results_of_a_start()
        next(folder.glob("total-*")).unlink()
    assert "/jax/compilation_cache/cache_hits" not in events


def test_threads_that_compile_at_once_leave_the_cache_of_jax_on():
    inside, ended = threading.Event(), threading.Event()

    @sj.cache.kept_jit
    def first(values):
        thread.start()
        inside.wait(0.5)  # in vain, because the other waits for this one
        return values

    @sj.cache.kept_jit
    def second(values):
        inside.set()
        ended.wait(5)
        return values

    name = "jax_persistent_cache_min_compile_time_secs"
    before, values = jax.config.values[name], jnp.ones(2)
    thread = threading.Thread(target=second, args=[values])
    first(values)
    ended.set()
    thread.join()
    assert jax.config.values[name] == before


def test_every_value_and_every_shape_has_a_file_of_its_own(folder):
    values = jnp.arange(4.0)
    squares(values), total(values)
    squares(values + 0), total(values + 1)  # the same values, and the same shapes
    assert made == ["squares", "total"]
    squares(values + 1e-6), squares(values, 3), squares(values, power=3)
    assert made[2:] == 3 * ["squares"]
    total((values,)), total(jnp.arange(5.0)), total(jnp.arange(4))
    assert made[5:] == 3 * ["total"]
    for _ in range(2):  # numbers are part of a program
        total((values, 2)), total((values, 3)), total((2, values))
    assert made[8:] == 3 * ["total"]
    assert len(list(folder.iterdir())) == 11


CHANGED = {
    "jaxlib": partial(mock.patch.object, jaxlib, "__version__", "0.0.1"),
    "source": partial(mock.patch.object, sj.cache, "_source", lambda: b"another"),
    "processor": partial(mock.patch.object, sj.cache, "_processor", lambda: "another"),
    "XLA_FLAGS": partial(mock.patch.dict, os.environ, XLA_FLAGS="--xla_cpu_enable_fast_math=true"),
    "settings": partial(jax.numpy_rank_promotion, "allow"),
}


@pytest.mark.parametrize("change", CHANGED.values(), ids=CHANGED)
def test_what_another_program_made_is_not_used(change):
    results_of_a_start()
    with change():
        results_of_a_start()
    assert made == 2 * ["squares", "total"]


def test_programs_are_kept_for_each_set_of_options_of_the_compiler(tmp_path, monkeypatch):
    monkeypatch.setattr(sj.cache, "_compiler_options", {})
    expected = results_of_a_start()
    for options in ({"xla_cpu_use_fusion_emitters": False}, {"xla_no_such_option": True}):
        sj.cache.keep(tmp_path, compiler_options=options)
        made.clear()
        assert results_of_a_start() == results_of_a_start() == expected
        assert made == ["total"]
    sj.cache.keep(tmp_path, compiler_options={"xla_cpu_use_fusion_emitters": "neither"})
    with pytest.raises(jax.errors.JaxRuntimeError):
        results_of_a_start()


class OfTheUser(eqx.Module):
    """Code that may change without splatjax."""

    values: jax.Array
    static: object = eqx.field(static=True, default=None)


def test_nothing_is_kept_of_code_of_the_user_or_while_jax_traces(folder, monkeypatch):
    ones = jnp.ones(3)
    total(OfTheUser(ones)), squares(np.ones(3))
    jax.jit(squares)(ones), jax.grad(lambda values: total(values)["sum"])(ones)
    monkeypatch.setattr(OfTheUser, "__module__", "splatjax.scene")
    total(OfTheUser(ones, lambda x: x))
    assert list(folder.iterdir()) == []
    total(OfTheUser(ones, "a word"))
    assert len(list(folder.iterdir())) == 1


def test_capacities_of_earlier_starts_are_reused(tmp_path):
    sizes = [int(planned(jnp.asarray(least))["size"]) for least in (100, 90)]
    sj.cache._capacities.clear()  # a start without the folder
    sizes.append(int(planned(jnp.asarray(80))["size"]))
    sj.cache._capacities.clear()
    sj.cache.keep(tmp_path)
    assert [*sizes, int(planned(jnp.asarray(95))["size"])] == [100, 100, 80, 100]


def test_what_was_not_used_for_longest_is_deleted(folder, monkeypatch):
    def files(start, kilobytes=10):
        squares(jnp.arange(start, start + kilobytes * 1000, dtype=jnp.uint8))
        return set(folder.iterdir())

    (used,) = files(0)
    (old,) = files(1) - {used}
    for path, age in ((used, 300), (old, 200)):
        os.utime(path, (0, time.time() - age))
    monkeypatch.setattr(sj.cache, "_LARGEST", 44_000)
    assert files(0) == files(2, 12) == {old, used}  # the second is more than a quarter
    files(3), files(4)
    left = files(5)
    assert len(left) == 4
    assert left & {old, used} == {used}


def test_a_folder_that_others_may_write_to_is_not_used(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(sj.cache, "_folder", None)
    folder.chmod(0o777)
    with pytest.raises(PermissionError, match=r"kept: .* delete it"):
        sj.cache.keep(tmp_path)
    squares(jnp.ones(3)), squares(jnp.ones(3))
    assert made == ["squares", "squares"]
    assert list(folder.iterdir()) == []


def test_the_default_is_the_cache_folder_of_the_user(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    for base, expected in (("relative", ".cache"), (str(tmp_path / "moved"), "moved")):
        monkeypatch.setenv("XDG_CACHE_HOME", base)
        assert sj.cache.keep().parent == tmp_path / expected / "splatjax" / "jax"


@pytest.mark.once
@pytest.mark.slow
def test_concurrent_and_killed_processes_leave_whole_files_alone(tmp_path):
    words = [SCRIPT, tmp_path / "shared"]
    statuses, printed, _ = run_together((words, {}), ([*words, "killed"], {}), (words, {}))
    assert statuses == [0, -signal.SIGKILL, 0]
    names = [path.name.partition("-")[0] for path in tmp_path.glob("shared/*/kept/*-*")]
    assert sorted(names) == ["solved", "squares", "total"]
    _, (after,), _ = run_together((words, {}))
    assert after.split() == printed[0].split()[:1] == printed[2].split()[:1]
