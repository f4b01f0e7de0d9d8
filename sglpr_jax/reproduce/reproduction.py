"""Tables and figures of the paper, reproduced from finished runs."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.protocols import PROTOCOLS
from sglpr_jax.files import write_json, write_text
from sglpr_jax.reproduce import pictures
from sglpr_jax.reproduce.experiments import EXPERIMENTS, FULL, TOP1
from sglpr_jax.reproduce.pictures import Pictures
from sglpr_jax.reproduce.runs import Runs
from sglpr_jax.reproduce.scores import across_sessions_rows, f1max_rows, methods_of, scored
from sglpr_jax.reproduce.tables import PUBLISHED, PaperTable, Row


@dataclass(frozen=True)
class Reproduction:
    """Input of tables and figures."""

    runs: Runs
    seqs: tuple[str, ...]
    """Test recordings."""
    methods: tuple[str, ...]
    """Handcrafted methods and weights for comparison."""
    sessions: Callable[[], Path]
    """Returns the folder of sessions in NCLT's layout. Called only by experiments that need sessions."""
    trained: bool = True
    """Whether there are runs of the variants."""

    def tables(self, name: str) -> dict[str, PaperTable]:
        """Return the tables with the reproduced numbers and the paper's, one for each protocol, by file name."""
        experiment = EXPERIMENTS[name]
        if experiment.across_sessions:
            columns, rows = across_sessions_rows(
                name, self.runs, self.seqs[0], self.sessions(), self.methods, trained=self.trained
            )
            caption = [*self._about(f"without recording {self.seqs[0]}"), "Recall@1 within 5 m"]
            return {name: _table(experiment.title, name, columns, rows, caption)}
        return {
            name if protocol == TOP1 else f"{name}-{protocol}": self._of_protocol(name, protocol)
            for protocol in experiment.protocols
        }

    def _of_protocol(self, name: str, protocol: str) -> PaperTable:
        rows = f1max_rows(name, self.runs, self.seqs, self.methods, protocol=protocol, trained=self.trained)
        poses = dict.fromkeys(self.runs.recording(seq).pose_source for seq in self.seqs)
        of_protocol = f"{protocol} ({PROTOCOLS[protocol].rule})"
        caption = [*self._about("leave-one-out"), of_protocol, f"poses: {', '.join(map(str, poses))}"]
        return _table(EXPERIMENTS[name].title, name, self.seqs, rows, caption)

    def _about(self, split: str) -> list[str]:
        """Describe the training of the variants."""
        trained = f"here: preset {Path(self.runs.preset).stem}, {self.runs.config.steps} steps, {split}"
        return [trained] if self.trained else []

    def pictures(self, name: str) -> Pictures:
        """Return the pictures of a figure by their file names. Some figures have one picture for each recording."""
        return _FIGURES[name](self)


def _table(title: str, name: str, columns: Sequence[str], rows: Sequence[Row], caption: Sequence[str]) -> PaperTable:
    if any(row.source == PUBLISHED for row in rows):
        caption = [*caption, "published: the paper's numbers, on the real dataset"]
    return PaperTable(f"{name}: {title}", rows, list(columns), "; ".join(caption))


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
    methods = methods_of("figure5", found.methods, trained=found.trained)
    return pictures.precision_recall(
        {seq: {label: scored(found.runs, method, seq) for method, label in methods.items()} for seq in found.seqs}
    )


def _trajectories(found: Reproduction) -> Pictures:
    return pictures.trajectories(found.runs, {seq: scored(found.runs, FULL, seq) for seq in found.seqs})


def _semantic_maps(found: Reproduction) -> Pictures:
    return pictures.semantic_maps(found.runs, found.seqs)


def _heat_maps(found: Reproduction) -> Pictures:
    seq, root = found.seqs[0], found.sessions()
    session = open_recording(root, recording_names(root)[-1])
    return pictures.feature_heat_maps(found.runs, seq, [found.runs.recording(seq), session])


def _categories(found: Reproduction) -> Pictures:
    return pictures.categories(functools.partial(_top1_score, found.runs), found.seqs)


def _top1_score(runs: Runs, variant: str, seq: str) -> float:
    return scored(runs, variant, seq).score


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


def write_experiment(name: str, found: Reproduction, folder: Path) -> list[PaperTable] | list[Path]:
    """Create and write the tables or pictures of an experiment. Returns the tables, or the paths of the pictures."""
    if EXPERIMENTS[name].kind == "figure":
        return write_pictures(found.pictures(name), folder)
    tables = found.tables(name)
    for file, table in tables.items():
        write_table(table, file, folder)
    return list(tables.values())
