from sglpr_jax.data import open_sequence

from .conftest import assert_one_line_error


def test_drives_are_written_completed_and_kept(command, tmp_path):
    out = tmp_path / "town"
    options = ("--out", out, "--scans", 3, "--azimuth-steps", 40, "--seed", 5)
    first = command("simulate", *options, "--seq", "08")
    assert first.status == 0 and "08" in first.out
    assert "simulating 1 drives of 3 scans, about 0 MB" in first.error
    drive = open_sequence(out, "08")
    assert len(drive) == 3 and drive.has_labels and len(drive.points(0)) > 500

    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.bin")}
    (out / "sequences" / "08" / "poses.txt").unlink()
    (out / "sequences" / "08" / "velodyne" / "000001.bin").unlink()
    again = command("simulate", *options, "--seq", "08")
    assert again.status == 0 and "simulating" in again.error
    after = {path: path.stat().st_mtime_ns for path in out.rglob("*.bin")}
    assert after.keys() == before.keys()
    assert [path.stem for path in after if after[path] != before[path]] == ["000001"]
    assert "simulating" not in command("simulate", *options, "--seq", "08").error

    other = command("simulate", "--out", out, "--scans", 4, "--azimuth-steps", 40, "--seed", 5, "--seq", "08")
    assert_one_line_error(other, "simulation.json", "scans 4", "found 3")


def test_a_drive_that_does_not_exist_is_refused(command, tmp_path):
    ended = command("simulate", "--out", tmp_path / "town", "--seq", "03", "--scans", 3)
    assert_one_line_error(ended, "00, 05, 08", "03")
    assert not (tmp_path / "town").exists()
