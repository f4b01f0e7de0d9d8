"""A traced program that is kept: the same descriptors, by the next process without tracing, and never a wrong one."""

import dataclasses
import functools
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.models import kept_program
from sglpr_jax.models.kept_program import kept_describe
from sglpr_jax.models.presets import model_preset

TINY = model_preset("tiny")
IMAGES = np.random.default_rng(0).poisson(0.7, (2, TINY.grid.height, TINY.grid.width)).astype(np.float32)


@pytest.fixture
def folder(tmp_path):
    """JAX's compilation cache, empty, and a process that has traced nothing."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "cache"))
    kept_program._programs.clear()
    yield tmp_path / "cache" / "traced"
    jax.config.update("jax_compilation_cache_dir", before)
    kept_program._programs.clear()


@pytest.fixture
def traced(monkeypatch):
    """How often `describe` was traced for a program to keep."""
    calls = []

    def counted(params, *images):
        calls.append(images)
        return sglpr_jax.describe(params, *images)

    monkeypatch.setattr(kept_program, "describe", counted)
    return calls


def as_a_new_process(params):
    kept_program._programs.clear()
    return kept_describe(params)


def test_the_second_time_nothing_is_traced_and_descriptors_are_the_same(folder, traced, random_params):
    params = random_params(TINY)
    expected = np.asarray(sglpr_jax.describe(params, IMAGES))
    np.testing.assert_array_equal(kept_describe(params)(IMAGES), expected)
    assert len(traced) == 1 and len(list(folder.iterdir())) == 1
    np.testing.assert_array_equal(as_a_new_process(params)(IMAGES), expected)
    other = jax.tree.map(lambda leaf: leaf * 1.1, params)  # other weights of the same model
    np.testing.assert_array_equal(kept_describe(other)(IMAGES), np.asarray(sglpr_jax.describe(other, IMAGES)))
    assert len(traced) == 1
    assert kept_describe(params)(IMAGES[0]).shape == (TINY.head.descriptor_size,)
    assert len(traced) == 2 and len(list(folder.iterdir())) == 2


def test_a_model_that_reads_labels(folder, random_params):
    head = dataclasses.replace(TINY.head, input="counts+labels")
    params = random_params(dataclasses.replace(TINY, head=head, categories=20))
    labels = np.random.default_rng(1).integers(0, 20, IMAGES.shape).astype(np.int32)
    expected = np.asarray(sglpr_jax.describe(params, IMAGES, labels))
    for _ in range(2):
        np.testing.assert_array_equal(as_a_new_process(params)(IMAGES, labels), expected)


@pytest.mark.parametrize(
    "damage", [lambda file: file.write_bytes(file.read_bytes()[:-9]), lambda file: file.write_bytes(b"")]
)
def test_a_damaged_program_is_traced_anew(folder, traced, random_params, damage):
    params = random_params(TINY)
    expected = np.asarray(kept_describe(params)(IMAGES))
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    damage(file)
    np.testing.assert_array_equal(as_a_new_process(params)(IMAGES), expected)
    assert len(traced) == 2 and file.read_bytes() == whole


def test_where_nothing_can_be_kept_it_is_traced(folder, traced, random_params):
    params = random_params(TINY)
    folder.parent.mkdir()
    folder.write_text("a file in the way")
    for times in (1, 2):
        assert as_a_new_process(params)(IMAGES).shape == (2, TINY.head.descriptor_size)
        assert len(traced) == times
    assert folder.read_text() == "a file in the way"


def test_weights_of_another_type_and_other_settings_have_programs_of_their_own(folder, traced, random_params):
    params = random_params(TINY)
    half = jax.tree.map(lambda leaf: leaf.astype(jnp.float16), params)
    for some in (half, params, half):
        np.testing.assert_array_equal(kept_describe(some)(IMAGES), np.asarray(sglpr_jax.describe(some, IMAGES)))
    assert len(traced) == 2
    with jax.default_matmul_precision("highest"):
        kept_describe(params)(IMAGES)
    assert len(traced) == 3 and len(list(folder.iterdir())) == 3


def test_other_code_and_models_have_other_programs(tmp_path, monkeypatch):
    code = tmp_path / "package"
    code.mkdir()
    (code / "model.py").write_text("one = 1")
    monkeypatch.setattr(kept_program, "PACKAGE", code)
    names = [kept_program._name((TINY,))]
    assert names == [kept_program._name((model_preset("tiny"),))]
    (code / "model.py").write_text("one = 11")
    names.append(kept_program._name((TINY,)))
    os.utime(code / "model.py", ns=(1, 1))
    names.append(kept_program._name((TINY,)))
    names.append(kept_program._name((model_preset("rings"),)))
    monkeypatch.setattr(kept_program.flax, "__version__", "0")
    names.append(kept_program._name((TINY,)))
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("jax_compilation_cache_dir", None),
        ("jax_compilation_cache_dir", ""),
        ("jax_compilation_cache_dir", "gs://bucket/cache"),
        ("jax_enable_compilation_cache", False),
    ],
)
def test_without_a_folder_to_keep_it_in_it_is_describe(random_params, setting, value):
    before = getattr(jax.config, setting)
    jax.config.update(setting, value)
    try:
        describe = kept_describe(random_params(TINY))
    finally:
        jax.config.update(setting, before)
    assert isinstance(describe, functools.partial) and describe.func is sglpr_jax.describe


def test_another_process_begins_with_what_this_one_kept(folder, random_params, tmp_path):
    params = random_params(TINY)
    sglpr_jax.save(params, tmp_path / "weights")
    np.save(tmp_path / "images.npy", IMAGES)
    expected = kept_describe(params)(IMAGES)
    program = """
import sys
import jax
import jax.numpy as jnp
import numpy as np
import sglpr_jax
from sglpr_jax.models import kept_program

def never(*_):
    raise AssertionError("traced")

kept_program.describe = never
found = kept_program.kept_describe(sglpr_jax.load(sys.argv[1]))(np.load(sys.argv[2]))
np.save(sys.argv[3], found)
"""
    arguments = [tmp_path / "weights", tmp_path / "images.npy", tmp_path / "found.npy"]
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(folder.parent)}
    subprocess.run([sys.executable, "-c", program, *map(str, arguments)], check=True, env=environment)
    np.testing.assert_array_equal(np.load(tmp_path / "found.npy"), expected)
