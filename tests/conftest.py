"""Test-wide settings: strict ranks, and where the development data lies."""

from pathlib import Path

import jax
import pytest

jax.config.update("jax_numpy_rank_promotion", "raise")

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of development data; real scans may not be redistributed, so a clone does not have it."""
    if not SHARED.is_dir():
        pytest.skip(f"no development data at {SHARED} (licences forbid shipping it)")
    return SHARED
