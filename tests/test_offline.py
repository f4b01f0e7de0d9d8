"""No command opens a connection: the whole job runs where every socket is refused."""

import socket

import numpy as np
import pytest

import sglpr_jax


@pytest.fixture
def no_network(monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("a connection was opened")

    for name in ("connect", "connect_ex", "bind", "sendto"):
        monkeypatch.setattr(socket.socket, name, refuse)
    for name in ("create_connection", "getaddrinfo"):
        monkeypatch.setattr(socket, name, refuse)


@pytest.mark.slow
def test_weights_descriptors_and_scores_need_no_network(no_network, tmp_path):
    sglpr_jax.simulate(tmp_path / "town", routes=["08"], scans=10, azimuth_steps=30)
    recording = sglpr_jax.open_recording(tmp_path / "town", "08")
    file = sglpr_jax.embed(sglpr_jax.load("sglpr-small"), recording)
    file.save(tmp_path / "08.npz")
    sglpr_jax.evaluate(tmp_path / "08.npz")
    assert np.isfinite(sglpr_jax.Index.of(file).query(file.descriptors).distances).all()
