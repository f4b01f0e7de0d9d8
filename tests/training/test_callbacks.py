"""Several callbacks are called as one would be."""

import inspect

import pytest

from sglpr_jax.training.callbacks import Callback, Callbacks

TOLD = {name: method for name, method in vars(Callback).items() if not name.startswith("_")}


def test_all_callbacks_are_called_in_their_order():
    told = []

    class Noting(Callback):
        def __init__(self, own: str):
            self._own = own

        def __getattribute__(self, name):
            if name not in TOLD:
                return super().__getattribute__(name)
            return lambda *values: told.append((self._own, name, values))

    both = Callbacks(Noting("first"), Noting("second"))
    for name, method in TOLD.items():
        wanted = list(inspect.signature(method).parameters)[1:]
        values = tuple({"recording": "00", "values": {"loss": 0.5}, "scores": {}}.get(each, 3) for each in wanted)
        getattr(both, name)(*values)
        assert told[-2:] == [("first", name, values), ("second", name, values)]
    assert len(told) == 2 * len(TOLD) > 10


def test_all_are_closed_in_their_order_where_one_cannot_be():
    closed = []

    class Closing(Callback):
        def __init__(self, own: str):
            self._own = own

        def close(self):
            closed.append(self._own)
            if self._own == "second":
                raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        Callbacks(*map(Closing, ("first", "second", "third"))).close()
    assert closed == ["first", "second", "third"]
