"""The public API as a whole: documented, in one style, and enough for the README's lines of Python."""

import inspect

import sglpr_jax

PUBLIC = [(name, getattr(sglpr_jax, name)) for name in sglpr_jax.__all__]
CALLABLES = [(name, member) for name, member in PUBLIC if callable(member)]
FUNCTIONS = [(name, inspect.signature(member)) for name, member in CALLABLES if not inspect.isclass(member)]
INPUTS_NOT_OPTIONS = {
    ("simulate_recording", "name"),
    ("open_recording", "name"),
    ("describe", "labels"),
    ("forward", "labels"),
    ("evaluate", "protocols"),
    ("taxonomy", "categories"),
}


def test_everything_public_is_documented():
    assert len(set(sglpr_jax.__all__)) == len(sglpr_jax.__all__)
    for name, member in CALLABLES:
        said = inspect.getdoc(member) or ""
        first = said.splitlines()[0] if said else ""
        assert len(first) > 20 and not first.startswith(f"{name}("), f"{name}: a dataclass's generated docstring"


def test_key_comes_first_and_options_are_named():
    for name, signature in FUNCTIONS:
        for position, parameter in enumerate(signature.parameters.values()):
            if parameter.name == "key" and parameter.default is parameter.empty:
                assert position == 0
            elif parameter.default is not parameter.empty and (name, parameter.name) not in INPUTS_NOT_OPTIONS:
                assert parameter.kind is parameter.KEYWORD_ONLY, (name, parameter.name)
