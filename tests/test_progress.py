from sglpr_jax import progress


def test_without_a_terminal_lines_tell_that_work_goes_on(monkeypatch, capsys):
    monkeypatch.setattr(progress, "PLAIN_EVERY_S", 0.0)
    with progress.progress_bar("embed 08", 3) as show:
        show(1)
        show(3, "3.1 scans/s")
    assert capsys.readouterr().err == "embed 08: 1 of 3\nembed 08: 3 of 3 3.1 scans/s\n"
    monkeypatch.setattr(progress, "PLAIN_EVERY_S", 1000.0)
    with progress.progress_bar("embed 08", 3) as show:
        show(3)
    assert not capsys.readouterr().err
