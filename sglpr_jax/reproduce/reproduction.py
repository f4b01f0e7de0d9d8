"""Tables and figures of the paper, reproduced from finished runs."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sglpr_jax.data import open_recording, recording_names
from sglpr_jax.evaluation import figures
from sglpr_jax.files import write_json, write_text
from sglpr_jax.reproduce import pictures
from sglpr_jax.reproduce.experiments import EXPERIMENTS, FULL
from sglpr_jax.reproduce.pictures import Pictures
from sglpr_jax.reproduce.runs import Runs
from sglpr_jax.reproduce.scores import across_sessions_rows, f1max_rows, methods_of, top1
from sglpr_jax.reproduce.tables import PUBLISHED, PaperTable


@dataclass(frozen=True)
class Reproduction:
    """Input of tables and figures."""

    runs: Runs
    seqs: tuple[str, ...]
    """Test recordings."""
    methods: tuple[str, ...]
    """Handcrafted methods for comparison."""
    sessions: Callable[[], Path]
    """Returns the folder of sessions in NCLT's layout. Called only by experiments that need sessions."""

    def table(self, name: str) -> PaperTable:
        """Return a table with the reproduced numbers and the paper's."""
        experiment = EXPERIMENTS[name]
        about = f"here: preset {Path(self.runs.preset).stem}, {self.runs.config.steps} steps"
        if experiment.across_sessions:
            columns, rows = across_sessions_rows(name, self.runs, self.seqs[0], self.sessions(), self.methods)
            caption = f"{about}, without recording {self.seqs[0]}; Recall@1 within 5 m"
        else:
            columns, rows = list(self.seqs), f1max_rows(name, self.runs, self.seqs, self.methods)
            caption = f"{about}, leave-one-out; top-1 F1max, 3 m / 20 m"
        if any(row.source == PUBLISHED for row in rows):
            caption += "; published: the paper's numbers, on the real dataset"
        return PaperTable(f"{name}: {experiment.title}", rows, columns, caption)

    def pictures(self, name: str) -> Pictures:
        """Return the pictures of a figure by their file names. Some figures have one picture for each recording."""
        return _FIGURES[name](self)


def write_table(table: PaperTable, name: str, folder: Path) -> None:
    """Write a table as JSON and as Markdown."""
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / f"{name}.md", table.markdown())
    write_json(folder / f"{name}.json", table.to_json())


def write_pictures(found: Pictures, folder: Path) -> list[Path]:
    """Write pictures. Returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, picture in found.items():
        figures.save(picture, folder / name)
    return [folder / name for name in found]


def _precision_recall(found: Reproduction) -> Pictures:
    methods = methods_of("figure5", found.methods)
    return pictures.precision_recall(
        {seq: {label: top1(found.runs, method, seq) for method, label in methods.items()} for seq in found.seqs}
    )


def _trajectories(found: Reproduction) -> Pictures:
    return pictures.trajectories(found.runs, {seq: top1(found.runs, FULL, seq) for seq in found.seqs})


def _semantic_maps(found: Reproduction) -> Pictures:
    return pictures.semantic_maps(found.runs, found.seqs)


def _heat_maps(found: Reproduction) -> Pictures:
    seq, root = found.seqs[0], found.sessions()
    session = open_recording(root, recording_names(root)[-1])
    return pictures.feature_heat_maps(found.runs, seq, [found.runs.recording(seq), session])


def _categories(found: Reproduction) -> Pictures:
    return pictures.categories(functools.partial(_top1_score, found.runs), found.seqs)


def _top1_score(runs: Runs, variant: str, seq: str) -> float:
    return top1(runs, variant, seq).score


_FIGURES: dict[str, Callable[[Reproduction], Pictures]] = {
    "figure5": _precision_recall,
    "figure6": _trajectories,
    "figure7": _semantic_maps,
    "figure8": _heat_maps,
    "figure9": _categories,
}


def chosen_experiments(names: Sequence[str]) -> list[str]:
    """Return the chosen tables and figures without duplicates. `all` selects every one."""
    return list(EXPERIMENTS) if "all" in names else list(dict.fromkeys(names))


def write_experiment(name: str, found: Reproduction, folder: Path) -> PaperTable | list[Path]:
    """Create and write a table or a figure. Returns the table, or the paths of the pictures."""
    if EXPERIMENTS[name].kind == "figure":
        return write_pictures(found.pictures(name), folder)
    table = found.table(name)
    write_table(table, name, folder)
    return table
