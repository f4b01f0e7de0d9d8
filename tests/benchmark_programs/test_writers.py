"""What is known of the files that the killed commands write."""

from sglpr_jax.training.mining import FOLDER


def test_mined_caches_are_files_that_vary():
    from benchmarks.robustness.writers import WRITERS, varies

    assert all(varies(WRITERS[name], f"run/{FOLDER}/0.npz") for name in ("train", "reproduce"))
