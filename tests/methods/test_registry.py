"""Every handcrafted method declares itself in its file, and the registry knows it by that."""

import importlib
from pathlib import Path

import pytest

from sglpr_jax.methods import handcrafted as package
from sglpr_jax.methods import learned
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.learned import LEARNED
from sglpr_jax.methods.learned.method import LearnedMethod
from sglpr_jax.methods.method import HandcraftedMethod
from sglpr_jax.methods.names import LEARNED_NAMES, METHODS
from sglpr_jax.retrieval.distances import DISTANCES


def test_every_file_of_the_folder_is_registered():
    declared = []
    for path in Path(package.__path__[0]).glob("*.py"):
        if path.stem != "__init__":
            file = importlib.import_module(f"{package.__name__}.{path.stem}")
            found = [value for value in vars(file).values() if isinstance(value, HandcraftedMethod)]
            assert found, f"{path.name} declares no method"
            declared += [method.name for method in found]
    assert sorted(declared) == sorted(HANDCRAFTED) and ("sglpr", *HANDCRAFTED) == METHODS


def test_every_learned_method_is_registered():
    declared = []
    for path in Path(learned.__path__[0]).glob("*.py"):
        file = importlib.import_module(f"{learned.__name__}.{path.stem}")
        declared += [value.name for value in vars(file).values() if isinstance(value, LearnedMethod)]
    assert set(declared) == set(LEARNED) and tuple(LEARNED) == LEARNED_NAMES


@pytest.mark.parametrize("name", LEARNED)
def test_a_learned_method_is_complete(name):
    method = LEARNED[name]
    assert method.name == name and method.source and method.licence and method.recipe.published
    assert list(method.recipe.learning_rates) == sorted(method.recipe.learning_rates)
    assert hash(method) == hash(LEARNED[name])  # compiled steps are kept by method


@pytest.mark.parametrize("name", HANDCRAFTED)
def test_a_method_says_its_source_and_how_its_descriptors_compare(name):
    method = HANDCRAFTED[name]
    assert method.name == name and method.source and method.distance_name in DISTANCES
    if method.distance is not None:
        assert DISTANCES[name] is method.distance
