"""bin/evaluate with --database: one session is the map, the others ask."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from sglpr_jax.cli.runtime import console, write_json, write_text
from sglpr_jax.evaluation.inputs.own_file import read_own_file
from sglpr_jax.evaluation.page.across_sessions import sessions_page
from sglpr_jax.evaluation.report import table, to_json
from sglpr_jax.evaluation.sessions import PUBLISHED_NOTE, AcrossSessions, evaluate_sessions, mean_score
from sglpr_jax.retrieval.descriptor_file import DescriptorFile


def evaluate_session_files(
    files: Sequence[Path], database: Path, *, protocols: Sequence[str], published: bool, folder: Path, page: str
) -> Path:
    """Print and write what the descriptor files score against the map in `database`; returns the folder written.

    Raises ValueError for files of something else than descriptors; see `evaluate_sessions` for the others.
    """
    map_file = _read(database)
    found = evaluate_sessions(map_file, [_read(path) for path in files], protocols)
    title = f"map {found.map_session}, {len(map_file)} scans; {len(files)} sessions ask"
    about = f"{database}: descriptors of {map_file.descriptors.shape[1]} numbers, compared by {map_file.distance}"
    html = sessions_page(found, title=title, about=about, published=published)
    _print(found, title, published)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "results.json", _as_json(found, files, database, published))
    write_text(folder / page, html)
    for name in ("results.json", page):
        print(f"written: {folder / name}")
    return folder


def _read(path: Path) -> DescriptorFile:
    if path.suffix != ".npz":
        raise ValueError(f"{path}: expected descriptor files of bin/embed (.npz) for an evaluation across sessions")
    return read_own_file(path, None)


def _print(found: AcrossSessions, title: str, published: bool) -> None:
    rows = Table(*found.columns, title=title)
    for row in found.rows():
        rows.add_row(*row)
    if published:
        rows.add_section()
        for row in found.published_rows():
            rows.add_row(*row)
    console().print(table([result for of_one in found.protocols.values() for result in of_one]))
    console().print(rows)
    if published:
        console().print(PUBLISHED_NOTE, soft_wrap=True)


def _as_json(found: AcrossSessions, files: Sequence[Path], database: Path, published: bool) -> dict[str, Any]:
    results = {
        name: {
            "mean": _or_null(mean_score(of_one)),
            "sessions": dict(zip(found.sessions, to_json(of_one), strict=True)),
        }
        for name, of_one in found.protocols.items()
    }
    beside = {"published": {"about": PUBLISHED_NOTE, "columns": found.columns, "rows": found.published_rows()}}
    about = {"files": [str(path) for path in files], "database": str(database), "map": found.map_session}
    return {**about, "results": results, **(beside if published else {})}


def _or_null(score: float) -> float | None:
    return None if math.isnan(score) else score
