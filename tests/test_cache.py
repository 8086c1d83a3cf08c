"""What is kept for the next start gives the same results, and nothing else is taken for it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
import pytest
from bodies import PLAIN, sheet, two_gaussians

import splatjax as sj
from splatjax import cache

SCRIPT = Path(__file__).parent / "kept_programs.py"
SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_logging_level",
    "jax_persistent_cache_min_compile_time_secs",
)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Keep in a folder of the test; restore all settings afterwards."""
    before = {name: jax.config.values[name] for name in SETTINGS}
    monkeypatch.setattr(cache, "_folder", None)
    monkeypatch.setattr(cache, "_programs", {})
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "jax"))
    yield cache.keep(tmp_path) / "kept"
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.fixture
def made():
    """How often each of two functions has been computed or traced."""
    return []


@pytest.fixture
def squares(made):
    @cache.kept
    def squares(values, power=2):
        made.append("squares")
        return {"squares": jnp.asarray(values) ** power}

    return squares


@pytest.fixture
def total(made):
    @cache.kept_jit
    def total(tree):
        made.append("total")
        return {"sum": sum(jnp.sum(jnp.sin(leaf)) for leaf in jax.tree.leaves(tree))}

    return total


def start_again():
    cache._programs.clear()


@pytest.mark.once
@pytest.mark.slow
def test_a_second_start_makes_the_same_picture_and_compiles_nothing(folder, compiled):
    light = sj.DirectionalLight([0, 0, -1.0], 3.0, cast_shadows=False)
    scene = sj.Scene(sheet(5.0, 1.0), [light], sj.Material(two_gaussians()))
    camera = sj.Camera.look_at([0, 0, 20.0], [0, 0, 0], width=8, height=8)

    def picture():
        start_again()
        plan = sj.make_plan(scene, camera, PLAIN)
        return sj.render(scene, camera, PLAIN, plan)

    first = picture()
    names = sorted(path.name.partition("-")[0] for path in folder.iterdir())
    assert names == ["make_plan", "render"]
    compiled.clear()
    second = picture()
    assert compiled == []
    assert eqx.tree_equal(first, second)


@pytest.mark.once
def test_the_bust_is_kept_by_count_and_seed(folder):
    first, second = sj.bust(50), sj.bust(50)
    assert eqx.tree_equal(first, second)
    assert len(list(folder.iterdir())) == 1
    assert not eqx.tree_equal(first, sj.bust(50, seed=1))
    assert len(list(folder.iterdir())) == 2


def halved(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def changed(path):
    content = bytearray(path.read_bytes())
    content[-9] ^= 1
    path.write_bytes(content)


def emptied(path):
    path.write_bytes(b"")


def replaced(path):
    path.write_bytes(next(other for other in path.parent.iterdir() if other != path).read_bytes())


def writable(path):
    path.chmod(0o666)


@pytest.mark.parametrize("damage", [halved, changed, emptied, replaced, writable])
def test_a_damaged_or_foreign_file_is_replaced(damage, folder, made, squares, total):
    def results():
        start_again()
        return np.asarray(squares(jnp.arange(9.0))["squares"]), float(total(jnp.arange(9.0))["sum"])

    expected = results()
    for name in ("squares", "total"):
        (path,) = folder.glob(f"{name}-*")
        damage(path)
        made.clear()
        np.testing.assert_array_equal(results()[0], expected[0])
        assert results()[1] == expected[1]
        assert made == [name]  # once, and the other one not at all


def test_a_program_that_loads_but_does_not_run_is_compiled_again(made, total, monkeypatch):
    def fails(*_):
        raise jax.errors.JaxRuntimeError("NOT_FOUND: a kernel")

    expected = total(jnp.ones(5))
    start_again()
    with monkeypatch.context() as patch:
        patch.setattr(cache, "deserialize_and_load", lambda *_: fails)
        assert total(jnp.ones(5)) == expected
    assert made == ["total", "total"]


def test_a_program_is_not_taken_out_of_the_cache_of_jax_to_be_kept(folder, total):
    """XLA would leave out some of its kernels; it is compiled instead."""
    jax.monitoring.register_event_listener(listener := lambda event, **_: events.append(event))
    events = []
    for _ in range(2):
        start_again()
        total(jnp.ones(7))
        next(folder.glob("total-*")).unlink()
    jax.monitoring.unregister_event_listener(listener)
    assert "/jax/compilation_cache/cache_hits" not in events


def test_every_value_and_every_shape_has_a_file_of_its_own(folder, made, squares, total):
    values = jnp.arange(4.0)
    squares(values), total(values)
    squares(values + 0), total(values + 1)  # the same values, and the same shapes
    assert made == ["squares", "total"]
    squares(values + 1e-6), squares(values, 3), squares(values, power=3)
    assert made[2:] == 3 * ["squares"]
    total((values,)), total(jnp.arange(5.0)), total(jnp.arange(4))
    assert made[5:] == 3 * ["total"]
    assert len(list(folder.iterdir())) == 8


@pytest.mark.parametrize("of", ["jaxlib", "source", "processor", "XLA_FLAGS", "settings"])
def test_what_another_program_made_is_not_used(of, made, squares, total, monkeypatch):
    squares(jnp.ones(3)), total(jnp.ones(3))
    start_again()
    with monkeypatch.context() as patch:
        if of == "jaxlib":
            patch.setattr(jaxlib, "__version__", "0.0.1")
        elif of == "XLA_FLAGS":
            patch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
        elif of != "settings":
            patch.setattr(cache, f"_{of}", lambda: b"another")
        with jax.default_matmul_precision("highest" if of == "settings" else None):
            squares(jnp.ones(3)), total(jnp.ones(3))
    assert made == 2 * ["squares", "total"]


class OfTheUser(eqx.Module):
    """Code that may change without splatjax."""

    values: jax.Array


class Static(eqx.Module):
    values: jax.Array
    function: object = eqx.field(static=True)


def test_nothing_is_kept_of_code_of_the_user_or_while_jax_traces(
    folder, squares, total, monkeypatch
):
    monkeypatch.setattr(Static, "__module__", "splatjax.scene")
    ones = jnp.ones(3)
    total(OfTheUser(ones))
    total(Static(ones, lambda x: x))
    jax.jit(squares)(ones), jax.grad(lambda values: total(values)["sum"])(ones)
    squares(np.ones(3))
    assert list(folder.iterdir()) == []
    total(Static(ones, "a word"))
    assert len(list(folder.iterdir())) == 1


def test_what_was_not_used_for_longest_is_deleted(folder, squares, monkeypatch):
    def values(start, kilobytes=10):
        return jnp.arange(start, start + kilobytes * 1000, dtype=jnp.uint8)

    squares(values(0))
    (used,) = folder.iterdir()
    squares(values(1))
    (old,) = set(folder.iterdir()) - {used}
    for path, age in ((used, 300), (old, 200)):
        os.utime(path, (0, time.time() - age))
    squares(values(0))
    monkeypatch.setattr(cache, "_LARGEST", 44_000)
    squares(values(2, 12))  # more than a quarter
    assert set(folder.iterdir()) == {old, used}
    squares(values(3)), squares(values(4)), squares(values(5))
    assert len(list(folder.iterdir())) == 4
    assert used.exists()
    assert not old.exists()


def test_a_folder_that_others_may_write_to_is_not_used(
    folder, tmp_path, squares, made, monkeypatch
):
    monkeypatch.setattr(cache, "_folder", None)
    folder.chmod(0o777)
    with pytest.raises(PermissionError, match="kept: others than you may write to it"):
        cache.keep(tmp_path)
    squares(jnp.ones(3)), squares(jnp.ones(3))
    assert made == ["squares", "squares"]
    assert list(folder.iterdir()) == []


def test_the_default_is_the_cache_folder_of_the_user(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    for base, expected in (("relative", ".cache"), (str(tmp_path / "moved"), "moved")):
        monkeypatch.setenv("XDG_CACHE_HOME", base)
        assert cache.keep().parent == tmp_path / expected / "splatjax" / "jax"


def test_importing_changes_no_setting_of_jax():
    program = """
import equinox, jax
before = dict(jax.config.values)
import splatjax, splatjax.cli
assert before == jax.config.values
"""
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.once
@pytest.mark.slow
def test_concurrent_and_killed_processes_leave_whole_files_alone(tmp_path):
    def started(*words):
        command = [sys.executable, str(SCRIPT), str(tmp_path / "shared"), *words]
        return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    processes = [started(*words) for words in ((), ("killed",), ())]
    outputs = [process.communicate(timeout=300)[0].split() for process in processes]
    assert [process.returncode for process in processes] == [0, -signal.SIGKILL, 0]
    (folder,) = (tmp_path / "shared").glob("*/kept")
    names = [path.name for path in folder.iterdir() if not path.name.startswith("tmp")]
    assert sorted(name.partition("-")[0] for name in names) == ["squares", "total"]
    after = started()
    assert after.communicate(timeout=300)[0].split() == [outputs[0][-1]] == [outputs[2][-1]]
